"""Starts processes and keeps them: on this machine, as units of systemd, in containers, of one robot or of several."""
