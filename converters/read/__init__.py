"""Files of many layouts in, `RawScene` out."""
