"""The worker's commands of the `pileus` program, one a file, registered as entry points."""
