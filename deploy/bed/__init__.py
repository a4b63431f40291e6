"""Two machines on one: network namespaces that only a radio joins, with delay, rate, loss and cuts."""
