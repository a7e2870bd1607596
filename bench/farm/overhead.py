"""What the farm costs: a 24-frame shot on a running farm beside `pileus render`, on the same cores.

    PYTHONPATH=tests .venv/bin/python -m farm.overhead --repeat 3

They take turns in one run, both at the priority that the farm gives rendering; the figure is the
ratio of the medians.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pileus_core as core

from pileus_service.client import Client
from pileus_service.shot import Shot
from pileus_worker.child import NICE
from pileus_worker.embedded import embedded_farm


def make_shot(folder: Path, samples: int) -> Shot:
    for frame in range(1, 25):
        path = folder / "caches" / f"cloud.{frame:04d}.vdb"
        path.parent.mkdir(exist_ok=True)
        core.make_cloud(str(path), frame=frame, frames=24, resolution=128)
    return Shot.model_validate(
        {
            "name": "overhead",
            "frames": "1-24",
            "image": {"width": 480, "height": 270, "output": str(folder / "out" / "####.exr")},
            "volumes": [
                {"cache": str(folder / "caches" / "cloud.####.vdb"), "extinction": 60.0}
                | {"anisotropy": 0.85}
            ],
            "camera": {"position": [0.15, 0.12, 1.9], "look_at": [0.0, 0.02, 0.0], "fov": 35.0},
            "lights": [
                {"type": "distant", "direction": [0.6, -0.55, -0.58], "irradiance": [3.0] * 3},
                {"type": "dome", "radiance": [0.3, 0.3, 0.3]},
            ],
            "sampling": {"samples": samples},
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--workers", type=int, default=1)
    asked = parser.parse_args()
    farm_took, here_took = list[float](), list[float]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shot = make_shot(folder, asked.samples)
        file = folder / "shot.json"
        file.write_text(shot.model_dump_json())
        pileus = Path(sys.executable).with_name("pileus")
        with (
            embedded_farm(folder / "farm", [folder], asked.workers, "127.0.0.1:0") as farm,
            Client(farm.url) as client,
        ):
            for _ in range(asked.repeat):
                begun = time.monotonic()
                subprocess.run(
                    ["nice", f"-n{NICE}", pileus, "render", file, "--out", folder / "here"],
                    check=True,
                    capture_output=True,
                )
                here_took.append(time.monotonic() - begun)
                begun = time.monotonic()
                job = client.submit(shot).job
                for view in client.watch(job.id):
                    job = view
                farm_took.append(time.monotonic() - begun)
                assert job.state == "done", job.reason
    here, there = statistics.median(here_took), statistics.median(farm_took)
    print(
        json.dumps(
            {
                "pileus_render_seconds": [round(each, 1) for each in here_took],
                "farm_seconds": [round(each, 1) for each in farm_took],
                "ratio_of_medians": round(there / here, 3),
            }
        )
    )


if __name__ == "__main__":
    main()
