"""A plan and furniture in; the scan of it, its colours and annotations out."""
