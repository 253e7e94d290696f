"""Read homes of other simulators: placed parts instead of a scan."""
