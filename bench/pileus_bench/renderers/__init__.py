"""One renderer a file, each run as a process of its own that answers `protocol`'s requests."""
