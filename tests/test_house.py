"""The house's rules that a reviewer would otherwise have to keep in mind."""

import ast
import importlib
import pickle
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from pydantic import ValidationError
from typer.main import get_command

from pileus_service.jobs import Cause, Merged, Planned, Rendered, Replan, Stale, Waiting
from pileus_worker import supervisor
from pileus_worker.child import MESSAGE, Beat, Failed, Finished, Message, Ready, Spent


def test_the_service_needs_neither_worker_nor_core() -> None:
    """A service host has no compiler: nothing in the service may need what it would build."""
    program = """
import importlib, pkgutil, sys
class Barred:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("pileus_worker", "pileus_core", "numpy", "PIL"):
            raise ImportError(f"{name} is barred")
sys.meta_path.insert(0, Barred())
import pileus_service
for module in pkgutil.walk_packages(pileus_service.__path__, "pileus_service."):
    importlib.import_module(module.name)
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_without_the_renderer_the_program_says_what_to_install() -> None:
    program = """
import sys
sys.modules["pileus_core"] = None
sys.argv = ["pileus", "render", "shot.toml"]
from pileus_service.cli import main
main()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == 1
    assert "pileus_core" in ended.stderr
    assert "pip install" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_every_command_is_one_of_the_program() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    listed = project["entry-points"]["pileus.commands"]
    for place in set(listed.values()):
        app = importlib.import_module(place.removesuffix(":app")).app
        command = get_command(app)
        family = {} if app.info.name else getattr(command, "commands", {})
        made = set(family) or {command.name}
        assert made == {name for name, source in listed.items() if source == place}


def test_nothing_that_a_client_sends_can_become_code() -> None:
    """No shell, no eval, no pickle from afar: service and worker know none of them."""
    house = Path(__file__).parents[1]
    barred = {"pickle", "marshal", "shelve", "dill", "eval", "exec", "system", "popen", "shell"}
    for file in [*house.glob("service/**/*.py"), *house.glob("worker/**/*.py")]:
        for node in ast.walk(ast.parse(file.read_text())):
            match node:
                case ast.Import(names=names):
                    used = {name.name.split(".")[0] for name in names}
                case ast.ImportFrom(module=str(module)):
                    used = {module.split(".")[0]}
                case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), keywords=keywords):
                    used = {name, *(word.arg or "" for word in keywords)}
                case _:
                    continue
            assert not used & barred, f"{file}:{node.lineno}"


@pytest.mark.parametrize(
    "message",
    [
        Beat(7, 2),
        Ready(),
        Failed("out of memory", Cause.MEMORY, Spent(1.5, 3, {"read": 0.25})),
        *(
            Finished(result, Spent())
            for result in (
                Planned(tasks=2, finished=[1], total=2, samples=9),
                Rendered(samples=4, taken=3),
                Merged(),
                Merged(redo=[3], reason="damaged"),
                Replan(),
                Waiting(wait="no such file"),
                Stale(stale="another size"),
            )
        ),
    ],
    ids=lambda message: type(getattr(message, "result", message)).__name__,
)
def test_a_render_child_is_heard_as_it_spoke_and_only_in_json(message: Message) -> None:
    assert MESSAGE.validate_json(MESSAGE.dump_json(message)) == message
    with pytest.raises(ValidationError):
        MESSAGE.validate_json(pickle.dumps(message))
    # Connection.recv would unpickle.
    assert ".recv(" not in Path(supervisor.__file__).read_text()
