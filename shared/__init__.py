"""The language the services speak: messages, topics, transport, robot model. Imports no service."""
