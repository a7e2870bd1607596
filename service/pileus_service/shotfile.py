"""Reads shots from TOML or JSON files, with `--set section.key=value` overrides."""

import contextlib
import json
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pileus_service.errors import InputError, one_line
from pileus_service.frames import has_pattern
from pileus_service.shot import Shot

MAX_BYTES = 1 << 20


def load_shot(path: Path, sets: Sequence[str] = ()) -> Shot:
    """The shot of a file, its paths absolute; any trouble is one line about the file."""
    data = _read(path)
    for setting in sets:
        _override(data, setting)
    return parse_shot(data, str(path)).anchored(path.resolve().parent)


def parse_shot(data: Any, source: str) -> Shot:
    try:
        return Shot.model_validate(data)
    except ValidationError as error:
        raise InputError(one_line(source, error)) from None


def check_camera(shot: Shot, source: str, frames: Iterable[int]) -> None:
    """Refuses a camera that goes blind on its way from key to key."""
    frame = shot.camera.first_blind(frames)
    if frame is not None:
        raise InputError(
            f"{source}: camera: position, look_at and up span no view at frame {frame}; part them"
        )


def check_files(shot: Shot, source: str, frames: Iterable[int], *, caches: bool = True) -> None:
    """Refuses a shot whose inputs are missing or whose output cannot be written; caches may be
    missing where they are waited for."""
    frames = list(frames)
    missing: dict[str, list[Path]] = {}
    for frame in frames:
        for field, file in shot.inputs(frame):
            with _troubles(source, field, file):
                there = file.is_file()
            if not there and (caches or not field.startswith("volumes.")):
                missing.setdefault(field, []).append(file)
    for field, files in missing.items():
        name = files[0]
        if len(files) < len(frames) and has_pattern(dict(_patterns(shot))[field]):
            raise InputError(
                f"{source}: {field}: the sequence has a gap of {len(files)} of {len(frames)} "
                f"frames, first {name}; make the file or leave the frame out of `frames`"
            )
        raise InputError(f"{source}: {field}: no such file {name}; mend the path")
    for output in {shot.output(frame) for frame in frames}:
        with _troubles(source, "image.output", output):
            if output.is_dir():
                raise InputError(f"{source}: image.output: {output} is a folder; name a file")
    for folder in {shot.output(frame).parent for frame in frames}:
        _check_writable(folder, source)


@contextlib.contextmanager
def _troubles(source: str, field: str, path: Path) -> Iterator[None]:
    """A path that the system refuses to look at is one line."""
    try:
        yield
    except OSError as error:
        reason = (error.strerror or "unreadable").lower()
        raise InputError(f"{source}: {field}: {reason}: {path}; mend the path") from None


def _patterns(shot: Shot) -> Iterable[tuple[str, str]]:
    yield from ((f"volumes.{i}.cache", volume.cache) for i, volume in enumerate(shot.volumes))
    for index, light in enumerate(shot.lights):
        if light.type == "dome" and light.texture:
            yield f"lights.{index}.texture", light.texture


def _check_writable(folder: Path, source: str) -> None:
    """Tries: permissions alone do not tell of read-only or full disks."""
    there = next(each for each in (folder, *folder.parents) if each.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        reason = (error.strerror or "fails").lower()
        raise InputError(
            f"{source}: image.output: cannot write in {there} ({reason}); choose another place"
        ) from None


def _read(path: Path) -> dict[str, Any]:
    kind = "JSON" if path.suffix.lower() == ".json" else "TOML"
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: over {MAX_BYTES} bytes; is this a shot?")
        text = path.read_text(encoding="utf-8-sig")  # some editors begin a file with a mark
        data = json.loads(text) if kind == "JSON" else tomllib.loads(text)
    except OSError as error:
        raise InputError(
            f"{path}: {(error.strerror or 'unreadable').lower()}; mend the path"
        ) from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # the parsers' own, and endless digits and nests
        raise InputError(f"{path}: is not {kind}: {error}"[:500]) from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: a shot is a table of name, frames, image, ...")
    return data


def _override(data: dict[str, Any], setting: str) -> None:
    key, equals, text = setting.partition("=")
    steps = key.strip().split(".")
    if not equals or not all(steps):
        raise InputError(f"--set {setting}: write section.key=value")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except (ValueError, RecursionError):
        value = text  # a bare word: a method, a path, a frame range
    here: Any = data
    for index, step in enumerate(steps):
        last = index == len(steps) - 1
        if isinstance(here, list):
            if not step.isdecimal() or int(step) >= len(here):
                raise InputError(f"--set {setting}: {step!r} is no index below {len(here)}")
            if last:
                here[int(step)] = value
            else:
                here = here[int(step)]
        elif isinstance(here, dict):
            if last:
                here[step] = value
            elif step not in here and steps[index + 1].isdecimal():
                whole = ".".join(steps[: index + 1])
                raise InputError(
                    f"--set {setting}: the shot has no {whole}; write all of it, {whole}=[...]"
                )
            else:
                here = here.setdefault(step, {})
        else:
            raise InputError(f"--set {setting}: {'.'.join(steps[:index])} has nothing inside it")
