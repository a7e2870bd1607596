"""`make demo`: an animated cloud, rendered with multiple scattering by a farm on this machine.

Run in the project's folder; all that it makes is under demo/.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import pileus_core as core

from pileus_service.client import Client
from pileus_service.errors import FarmError, InputError
from pileus_service.jobs import JobState
from pileus_service.shot import Shot
from pileus_service.shotfile import load_shot
from pileus_service.watching import wait_for
from pileus_worker.commands.compare import read_rgb
from pileus_worker.commands.make import make
from pileus_worker.embedded import embedded_farm
from pileus_worker.pictures import Image, contact_sheet, strip, to_display, write_png

SHOT = Path("examples/cumulus.toml")
FOLDER = Path("demo").resolve()
FRAMES = "1-24"
RESOLUTION = 256
STILL = 12
EXPOSURE = 0.0
PANELS = (
    ("single", 1, "single scattering"),
    ("contrast", 8, "contrast approximation"),
    ("multiple", 16, "multiple scattering"),
)


def shot(name: str, *settings: str) -> Shot:
    """The example's shot, smaller, denoised where that can be, and into the demo's folder."""
    denoise = find_spec("pyoidn") is not None
    return load_shot(
        SHOT,
        [
            f"name={name}",
            f"frames='{FRAMES}'",
            "image.width=640",
            "image.height=360",
            f"image.denoise={str(denoise).lower()}",
            "sampling.samples=8",
            f"image.output='{FOLDER}/frames/{name}.####.exr'",
            f"volumes.0.cache='{FOLDER}/caches/cumulus.####.vdb'",
            *settings,
        ],
    )


def run() -> None:
    whole = shot("cumulus")
    if not all(path.exists() for frame in whole.frame_numbers for _, path in whole.inputs(frame)):
        make("cloud", whole.volumes[0].cache, FRAMES, RESOLUTION)
    stills = {
        label: shot(
            method,
            f"frames={STILL}",
            "sampling.samples=16",
            f"transport.method={method}",
            f"transport.max_bounces={bounces}",
        )
        for method, bounces, label in PANELS
    }
    with (
        embedded_farm(FOLDER / "farm", [FOLDER], 2, "127.0.0.1:0") as farm,
        Client(farm.url) as client,
    ):
        for each in (whole, *stills.values()):
            job = wait_for(client, client.submit(each).job)
            if job.state is not JobState.DONE:
                raise FarmError(f"{job.name}: {job.state}: {job.reason}")
    sheet = contact_sheet([_display(whole, frame) for frame in whole.frame_numbers])
    write_png(FOLDER / "contact-sheet.png", sheet)
    panels = [(label, _display(still, STILL)) for label, still in stills.items()]
    write_png(FOLDER / "methods.png", strip(panels))
    print(f"The frames:      {whole.output(1).parent}/cumulus.####.exr")
    print(f"A contact sheet: {FOLDER / 'contact-sheet.png'}")
    print(f"Three methods:   {FOLDER / 'methods.png'}")


def _display(of: Shot, frame: int) -> Image:
    return to_display(read_rgb(of.output(frame), None), EXPOSURE)


if __name__ == "__main__":
    try:
        run()
    except (InputError, FarmError, core.InputError) as error:
        sys.exit(f"make demo: {error}")
    except KeyboardInterrupt:
        sys.exit("make demo: stopped")
