"""Linkages: their links and joints, coordinates and singularities."""
