"""What learned policies see and do, drawn."""
