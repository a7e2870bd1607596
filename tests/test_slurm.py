"""deploy/slurm against a real slurmctld and slurmd on this host: workers cancelled, preempted."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest
from redis import Redis

from hosts import PILEUS, free_port, process, same_images, service, until
from pileus_service.client import Client
from pileus_service.jobs import WorkerView
from pileus_service.queue import Queue
from pileus_service.shot import Shot

SCRIPT = Path(__file__).parent.parent / "deploy" / "slurm" / "pileus-workers.sbatch"
DAEMONS = ("munged", "slurmctld", "slurmd")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.geteuid() != 0 or not all(map(shutil.which, DAEMONS)),
        reason="needs root, munge and slurm-wlm (`make test-slow` installs them)",
    ),
]

# The machine may have fewer cores than it says: nothing is bound to one.
SETTINGS = """
ClusterName=pileus
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SlurmctldPort={controller}
SlurmdPort={node}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldParameters=preempt_send_user_signal
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=1
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
KillWait=20
NodeName={host} NodeAddr=127.0.0.1 CPUs=4 RealMemory=4000
PartitionName=low Nodes=ALL Default=YES PriorityTier=1 GraceTime=30 State=UP
PartitionName=high Nodes=ALL PriorityTier=10 PreemptMode=OFF State=UP
"""


class Slurm:
    """Its commands, as a user gives them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.env = {"SLURM_CONF": str(folder / "slurm.conf"), "PILEUS": str(PILEUS)}

    def __call__(self, *words: str | Path) -> str:
        ended = subprocess.run(
            words,
            env={**os.environ, **self.env},
            cwd=self.folder,
            capture_output=True,
            text=True,
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout.strip()

    def states(self, job: str) -> list[str]:
        return self("squeue", "-h", "-r", "-j", job, "-o", "%T").split()


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    folder = tmp_path_factory.mktemp("slurm")
    for name in ("state", "spool"):
        (folder / name).mkdir()
    settings = SETTINGS.format(
        host=socket.gethostname().partition(".")[0],
        folder=folder,
        controller=free_port(),
        node=free_port(),
    )
    (folder / "slurm.conf").write_text(settings)
    key = folder / "munge.key"
    key.touch(0o600)
    key.write_bytes(os.urandom(128))
    cluster = Slurm(folder)
    munge = [f"--{kind}-file={folder}/munge.{kind}" for kind in ("key", "pid", "log", "seed")]
    munge += [f"--socket={folder}/munge.socket", "--foreground", "--force"]
    with ExitStack() as daemons:
        for words in (["munged", *munge], ["slurmctld", "-D", "-c"], ["slurmd", "-D"]):
            log = folder / f"{words[0]}.out"
            daemons.enter_context(process(log, *words, env=cluster.env))
            if words[0] == "munged":
                until((folder / "munge.socket").exists, 20)
        sinfo = ["sinfo", "-h", "-p", "low", "-o", "%t"]
        until(lambda: _answers(cluster, sinfo) == "idle", 60)
        yield cluster


def _answers(slurm: Slurm, words: list[str]) -> str:
    try:
        return slurm(*words)
    except AssertionError:
        return ""


@pytest.fixture
def long_shot(tmp_path: Path, shot: dict[str, Any]) -> Shot:
    core.make_cloud(str(tmp_path / "cloud.vdb"), frame=1, frames=1, resolution=48)
    shot["image"] |= {"width": 96, "height": 64}
    shot["volumes"][0]["cache"] = str(tmp_path / "cloud.vdb")
    shot["sampling"]["samples"] = 600
    return Shot.model_validate(shot)


@pytest.fixture
def client(tmp_path: Path, redis_url: str, redis: Redis) -> Iterator[Client]:
    with service(tmp_path / "data", redis_url, tmp_path) as client:
        yield client


@pytest.fixture
def array(slurm: Slurm, tmp_path: Path, redis_url: str) -> Iterator[str]:
    """Two workers, each with a core and 900 MB."""
    options = ["--parsable", "--array=1-2", "--cpus-per-task=1", "--mem=900M"]
    farm = ["--data", str(tmp_path / "data"), "--redis", redis_url, "--root", str(tmp_path)]
    job = slurm("sbatch", *options, SCRIPT, *farm)
    yield job
    slurm("scancel", job)
    until(lambda: not slurm.states(job), 60)


def rendering(client: Client) -> list[WorkerView]:
    return [each for each in client.workers() if each.task and each.task.kind == "render"]


def test_workers_take_what_slurm_gives_and_a_cancelled_one_hands_its_task_back(
    slurm: Slurm, client: Client, array: str, redis: Redis, long_shot: Shot, tmp_path: Path
) -> None:
    until(lambda: len(client.workers()) == 2, 180)
    assert {worker.threads for worker in client.workers()} == {1}
    given = Path(f"/proc/{client.workers()[0].pid}/cmdline").read_text().split("\0")
    assert float(given[given.index("--memory") + 1]) == pytest.approx(0.9 * 900 / 1024, rel=1e-3)
    scratch = Path(f"/proc/{client.workers()[0].pid}/environ").read_text().split("\0")
    [folder] = [Path(word.removeprefix("TMPDIR=")) for word in scratch if word.startswith("TMPDIR")]
    assert folder.is_dir()

    job = client.submit(long_shot).job.id
    until(lambda: len(rendering(client)) == 2, 180)
    slurm("scancel", f"{array}_1")
    until(lambda: len(client.workers()) == 1, 25)
    until(lambda: slurm.states(array) == ["RUNNING"], 30)
    until(lambda: client.job(job).state in ("done", "failed"), 900)
    assert client.job(job).state == "done", client.job(job).reason
    # Handed back, not waited for and not counted as failed.
    stats = Queue(redis).stats()
    assert stats.get("attempts_failed", 0) == stats.get("leases_lost", 0) == 0
    same_images(long_shot, tmp_path)
    slurm("scancel", array)
    until(lambda: not folder.exists(), 30)


def test_preempted_workers_hand_back_and_come_again(
    slurm: Slurm, client: Client, array: str, redis: Redis, long_shot: Shot, tmp_path: Path
) -> None:
    until(lambda: len(client.workers()) == 2, 180)
    before = {worker.name for worker in client.workers()}
    job = client.submit(long_shot).job.id
    until(lambda: len(rendering(client)) == 2, 180)
    slurm("sbatch", "--partition=high", "--exclusive", "--wait", "--wrap", "true")
    # The grace is 30 s: they did not wait for its end to be killed.
    assert slurm.states(array) == ["PENDING", "PENDING"]
    assert not client.workers()
    assert client.job(job).state == "running"
    until(lambda: _due(slurm, array), 300)
    until(lambda: len(client.workers()) == 2, 180)
    assert not before & {worker.name for worker in client.workers()}
    until(lambda: client.job(job).state in ("done", "failed"), 900)
    assert client.job(job).state == "done", client.job(job).reason
    stats = Queue(redis).stats()
    assert stats.get("attempts_failed", 0) == stats.get("leases_lost", 0) == 0
    same_images(long_shot, tmp_path)


def _due(slurm: Slurm, job: str) -> bool:
    """Slurm holds requeued jobs back for two minutes; an operator need not wait."""
    for task in (1, 2):
        if "BeginTime" in slurm("squeue", "-h", "-j", f"{job}_{task}", "-o", "%r"):
            slurm("scontrol", "update", f"JobId={job}_{task}", "StartTime=now")
    return slurm.states(job) == ["RUNNING", "RUNNING"]
