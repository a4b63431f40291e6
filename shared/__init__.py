"""Shared library of the services: messages, topics, transport and robot model.

It imports no service.
"""
