"""Recorder of topics to MCAP files.

It is a separate process, so that no other service waits for the disk.
"""
