"""The commands that need no renderer, each loaded when it is asked for."""
