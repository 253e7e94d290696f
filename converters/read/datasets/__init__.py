"""Published collections of scans in, `RawScene` out, through a library that reads them."""
