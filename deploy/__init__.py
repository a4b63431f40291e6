"""Starts the services: process table, launcher, command line, reports, compose files."""
