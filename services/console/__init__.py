"""The operator's page: a web server that shows what the robot sees and does, and passes on what its operators ask for."""
