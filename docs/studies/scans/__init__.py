"""Studies of converted scans."""
