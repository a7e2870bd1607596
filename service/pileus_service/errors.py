"""The errors that a user can mend; each message is the one line that reaches them."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError


def printable(text: str) -> str:
    """Text as one line that no terminal obeys: what a file or caller put in is shown escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class InputError(ValueError):
    """Wrong input: the message names the file, the field and the mend (exit code 2)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class ForeignError(InputError):
    """Redis or the data folder is another farm's: nothing there is ours to change."""


class FarmError(RuntimeError):
    """The work failed although the input was right (exit code 1)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


@contextlib.contextmanager
def data_troubles(data: Path) -> Iterator[None]:
    """What the system refuses to do in the data folder is one line."""
    try:
        yield
    except OSError as error:
        raise InputError(f"--data {data}: {error.strerror}; choose another folder") from None


def one_line(source: str, error: ValidationError) -> str:
    """The first trouble of a validation error as one line, with a count of the others."""
    first, *others = own_troubles(error.errors(include_url=False))
    where = ".".join(place_of(first))
    message = in_plain_words(first)
    value = first["input"]
    shown = f" = {value!r:.80}" if isinstance(value, str | int | float) and where else ""
    more = f" (and {len(others)} more)" if others else ""
    return f"{source}: {where}{shown}: {message}{more}" if where else f"{source}: {message}{more}"


def own_troubles(errors: Sequence[Any]) -> list[Any]:
    """Pydantic's errors without those that only follow from another: it counts an item that is
    wrong as none, and so finds its list too short."""
    places = [error["loc"] for error in errors]

    def follows(error: Any) -> bool:
        size = len(error["loc"])
        return error["type"] == "too_short" and any(
            len(place) > size and place[:size] == error["loc"] for place in places
        )

    return [error for error in errors if not follows(error)]


def place_of(error: Any) -> list[str]:
    """Where one of pydantic's errors is: keys and indices from the outside in. The tag of a union's
    member ("distant") is part of pydantic's location, not of what was given."""
    return [str(part) for part in error["loc"] if part not in _UNION_TAGS]


def in_plain_words(error: Any) -> str:
    """What one of pydantic's errors says, without its talk of tuples and tags."""
    if words := _WORDS.get(error["type"]):
        return words.format_map(error.get("ctx", {}))
    return str(error["msg"]).removeprefix("Value error, ")


_A_LIST = "must be a list; put it into brackets, [...]"
_A_TABLE = "must be a table; give its keys with their values"
_WORDS = {
    "tuple_type": _A_LIST,
    "list_type": _A_LIST,
    "too_short": "has {actual_length} items; give at least {min_length}",
    "too_long": "has more than {max_length} items; take some out",
    "model_type": _A_TABLE,
    "model_attributes_type": _A_TABLE,
    "union_tag_not_found": "has no {discriminator}; give one, as 'distant' or 'dome'",
    "union_tag_invalid": "{discriminator} is '{tag:.80}'; give one of {expected_tags}",
}
_UNION_TAGS = {"distant", "dome", "constant", "keyed"}
