"""Batches of motions: members, chunks, and where results are kept."""
