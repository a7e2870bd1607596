"""`pileus render`: a shot, here and now, in this process."""

import json
import math
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Annotated, Any

import pileus_core as core
import typer

from pileus_service.jobs import Resolved
from pileus_service.options import AsJson, Frames, Sets, ShotFile
from pileus_service.progress import Display, Row, duration
from pileus_service.shot import Shot
from pileus_service.shotfile import check_camera, check_files, load_shot
from pileus_worker import deciding, machine, scene
from pileus_worker.caches import Caches
from pileus_worker.denoising import check_installed, denoise
from pileus_worker.errors import plain_errors
from pileus_worker.sampling import Sampler

app = typer.Typer()

# What was decided, the frame, and what is odd in its files.
Rendered = tuple[Resolved, core.Frame, list[str]]


@app.command("render")
def render(
    shot_file: ShotFile,
    frames: Frames = None,
    sets: Sets = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Writes the images here.")] = None,
    threads: Annotated[int, typer.Option(min=0, max=1024, help="0 takes all cores.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Renders a shot here and now: no farm needed."""
    settings = [*(sets or []), *([f"frames={json.dumps(frames)}"] if frames is not None else [])]
    shot = load_shot(shot_file, settings)
    if out is not None:
        output = str(out.resolve() / Path(shot.image.output).name)
        shot = shot.model_copy(update={"image": shot.image.model_copy(update={"output": output})})
    check_camera(shot, str(shot_file), shot.frame_numbers)
    check_files(shot, str(shot_file), shot.frame_numbers)
    check_installed(shot, str(shot_file))
    for warning in shot.warnings():
        print(f"{shot_file}: warning: {warning}", file=sys.stderr)
    with plain_errors(str(shot_file)), Display() as display:
        reports = Renderer(shot, threads, display).all_frames()
    if as_json:
        print(json.dumps({"frames": reports}))


class Renderer:
    """The frames of a shot one by one; the next cache is read while one renders."""

    def __init__(self, shot: Shot, threads: int, display: Display) -> None:
        self._shot = shot
        self._threads = threads or machine.cores()
        self._display = display
        self._frames = shot.frame_numbers
        self._first: Resolved | None = None  # what was decided for the first frame
        self._caches = Caches(machine.cache_bytes())
        self._begun = time.monotonic()
        self._pixels_done = 0

    def all_frames(self) -> list[dict[str, Any]]:
        return [self._frame(index, frame) for index, frame in enumerate(self._frames)]

    def _frame(self, index: int, number: int) -> dict[str, Any]:
        shot, image = self._shot, self._shot.image
        begun = time.monotonic()
        grid = shot.volumes[0].density
        volume = self._caches.get(scene.cache_of(shot, number), grid)
        if index + 1 < len(self._frames):
            self._caches.read_ahead(scene.cache_of(shot, self._frames[index + 1]), grid)
        rendering = time.monotonic()
        resolved, frame, warnings = self._watched(index, number, volume)
        render_seconds = time.monotonic() - rendering
        denoise(frame, shot, self._threads)
        output = shot.output(number)
        output.parent.mkdir(parents=True, exist_ok=True)
        header = scene.header(shot, number, resolved, render_seconds, frame)
        frame.write(str(output), half=image.pixel_type == "half", header=header)
        seconds = time.monotonic() - begun
        self._display.note(f"frame {number}: {output}, {duration(seconds)}")
        if frame.bounded_paths:
            self._display.note(
                f"frame {number}: {frame.bounded_paths} paths met the bound on work and were ended"
            )
        if unmet := frame.unmet_buckets:
            self._display.note(
                f"frame {number}: warning: {unmet} of its buckets have had all the samples they "
                "may have and are not within the tolerance; raise sampling.samples"
            )
        error = frame.relative_error()
        return {
            "frame": number,
            "file": str(output),
            "seconds": seconds,
            "load_seconds": volume.load_seconds,
            "render_seconds": render_seconds,
            "samples": round(frame.mean_samples),
            "error": error if math.isfinite(error) else None,  # of what was rendered
            "unmet_buckets": unmet,
            "method": resolved.method,
            "max_bounces": resolved.max_bounces,
            "reason": resolved.reason,
            "bounded_paths": frame.bounded_paths,
            "warnings": warnings,
        }

    def _watched(self, index: int, number: int, volume: core.Volume) -> Rendered:
        """Renders with progress; a Ctrl-C stops the renderer's threads too."""
        control = core.Control()
        with ThreadPoolExecutor(1) as executor:
            future = executor.submit(self._render, number, volume, control)
            try:
                while not wait([future], 0.1).done:
                    self._show(index, number, control.samples_done)
            except BaseException:
                # It ends at once; a second Ctrl-C must not cut that short.
                signal.signal(signal.SIGINT, signal.SIG_IGN)
                control.cancel()
                raise
            return future.result()

    def _render(self, number: int, volume: core.Volume, control: core.Control) -> Rendered:
        shot = self._shot
        self._pixels_done = 0
        resolved = deciding.resolve(
            shot,
            number,
            lambda: volume,
            threads=self._threads,
            control=control,
            earlier=self._first,
        )
        self._first = self._first or resolved
        warnings: list[str] = []
        view = scene.make_scene(shot, number, volume, warn=warnings.append)
        for warning in warnings:
            self._display.note(f"frame {number}: warning: {warning}")
        sampler = Sampler(
            view,
            shot,
            resolved,
            frame=number,
            threads=self._threads,
            control=control,
        )
        return resolved, sampler.whole(self._count), warnings

    def _count(self, pixels: int) -> None:
        self._pixels_done += pixels

    def _show(self, index: int, number: int, samples: int) -> None:
        image, sampling = self._shot.image, self._shot.sampling
        pixels = image.width * image.height
        if sampling.tolerance is None:
            total = pixels * sampling.samples
            here = min(1.0, samples / total)
            told = f"{samples / 1e6:.1f} of {total / 1e6:.1f} M samples"
        else:
            here = self._pixels_done / pixels
            told = f"{samples / 1e6:.1f} M samples"
        all_done = (index + here) / len(self._frames)
        spent = time.monotonic() - self._begun
        left = duration(spent * (1 - all_done) / all_done) if all_done > 0 else "-"
        self._display.show(
            Row(self._shot.name, all_done, f"{index} of {len(self._frames)} frames, {left} left"),
            Row(f"  frame {number}", here, told),
        )
