"""Train networks on images and labels."""
