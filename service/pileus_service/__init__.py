"""The farm's service: the shot and job models, the queue on Redis, the HTTP API and its client."""

from importlib.metadata import version

__version__ = version("pileus")
