"""`python -m pileus_worker` is `pileus worker`, for parents that start workers."""

from pileus_service.errors import InputError
from pileus_worker.commands.worker import app

if __name__ == "__main__":
    try:
        app()
    except InputError as error:
        raise SystemExit(f"pileus worker: {error}") from None
