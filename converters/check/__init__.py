"""Check scenes: settle objects, judge gates, draw the conversion."""
