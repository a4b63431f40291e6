"""What the commands of `sextant` do, a file per group; their arguments are declared in `sextant.deploy.cli`."""
