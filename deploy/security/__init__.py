"""Access control of routers: hosting, certificates, and TLS proxies."""
