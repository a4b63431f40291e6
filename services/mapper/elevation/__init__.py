"""Fuse scans into the elevation map."""
