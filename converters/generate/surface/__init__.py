"""Turn a plan and furniture into a scan, its colours and annotations."""
