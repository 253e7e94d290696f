"""What every reader fills and every stage takes."""
