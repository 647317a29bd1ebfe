"""Controllers, drives, and reference motions along paths."""
