"""Define the wire: messages, topics, encoding, transport and access roles."""
