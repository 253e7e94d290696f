"""Draw what runs have written: metrics, rows and recorded paths become pictures and tables."""
