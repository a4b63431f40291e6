"""Serve the operator's page: web server, sockets, and what each page may see and command."""
