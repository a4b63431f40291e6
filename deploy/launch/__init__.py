"""Launch of processes: locally, as systemd units, in containers, or for a fleet; and discovery of other machines."""
