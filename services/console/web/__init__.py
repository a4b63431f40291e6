"""Web server of the console: pages, their requests and the arbitration of control."""
