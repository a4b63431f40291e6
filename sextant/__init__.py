"""Six-legged walking where only some places carry a foot."""
