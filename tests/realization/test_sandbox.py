"""The child process of the sandbox: results, limits and reports of crashes."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from model_texts import PENDULUM, written

from pytest_twin.errors import LimitError, ModelError, SimulationError
from pytest_twin.realization import Sandbox


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox(seconds=30) as found:
        yield found


def test_results_of_a_call_are_returned_unchanged(sandbox: Sandbox) -> None:
    value = {"a": [1, 2.5, None, True, "ü\n"], "big": "x" * 300_000}
    assert sandbox.call("sandboxed:echo", {"value": value}) == value


def test_one_child_process_serves_several_calls(sandbox: Sandbox) -> None:
    first = sandbox.call("sandboxed:process")
    assert first != os.getpid()
    assert sandbox.call("sandboxed:process") == first


def test_progress_and_printed_output_reach_the_parent(sandbox: Sandbox) -> None:
    seen: list[float] = []
    assert sandbox.call("sandboxed:count", {"steps": 4}, progress=seen.append) == "done"
    assert seen == [0.25, 0.5, 0.75, 1.0]
    assert sandbox.output == "step 0\nstep 1\nstep 2\nstep 3\n"


def test_a_typed_error_keeps_all_its_fields(sandbox: Sandbox) -> None:
    with pytest.raises(ModelError) as caught:
        sandbox.call("sandboxed:raise_model_error")
    assert str(caught.value) == "/a/b.xml:3:2: x: bad (got 1.5 kg; expected more)"


def test_an_untyped_error_is_reported_with_its_file(
    sandbox: Sandbox, importable_functions: Path
) -> None:
    with pytest.raises(SimulationError) as caught:
        sandbox.call("sandboxed:raise_value_error")
    error = caught.value
    assert error.path == importable_functions / "sandboxed.py"
    assert "\n" not in str(error)
    assert "ValueError: a user's own mistake" in str(error)
    assert "Traceback" in sandbox.output


def test_a_result_that_is_not_json_is_an_error_and_the_child_survives(sandbox: Sandbox) -> None:
    before = sandbox.call("sandboxed:process")
    with pytest.raises(SimulationError, match="not JSON serializable"):
        sandbox.call("sandboxed:give_an_object")
    assert sandbox.call("sandboxed:process") == before


@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGFPE", "SIGKILL"])
def test_a_crash_is_reported_and_the_next_call_starts_a_new_child(
    sandbox: Sandbox, name: str
) -> None:
    before = sandbox.call("sandboxed:process")
    with pytest.raises(SimulationError, match=rf"crashed \({name}\); .*about to crash"):
        sandbox.call("sandboxed:crash", {"name": name})
    assert sandbox.call("sandboxed:process") != before


def test_an_exit_of_the_child_is_reported_with_its_status(sandbox: Sandbox) -> None:
    with pytest.raises(SimulationError, match="ended with exit status 3"):
        sandbox.call("sandboxed:leave", {"status": 3})


def test_an_endless_call_is_killed_at_its_time_limit(sandbox: Sandbox) -> None:
    child = sandbox.call("sandboxed:process")
    start = time.monotonic()
    time.sleep(0.3)
    delay = time.monotonic() - start - 0.3  # by other programs
    start = time.monotonic()
    with pytest.raises(LimitError, match=r"time limit and was killed \(expected at most 0\.3 s\)"):
        sandbox.call("sandboxed:spin", seconds=0.3)
    assert time.monotonic() - start < 3 + 10 * delay
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_an_endless_compilation_is_killed_at_its_time_limit(
    sandbox: Sandbox, tmp_path: Path
) -> None:
    """MuJoCo simulates length ranges of muscles during compilation, as long as the model states."""
    text = PENDULUM.replace(
        '<compiler angle="radian"/>',
        "<compiler><lengthrange mode='all' inttotal='1e9' timestep='1e-5'/></compiler>",
    )
    path = written(tmp_path, text)
    sandbox.call("sandboxed:load_model", {"path": str(written(tmp_path, PENDULUM, "ok.xml"))})
    with pytest.raises(LimitError, match="time limit and was killed"):
        sandbox.call("sandboxed:compile_without_end", {"path": str(path)}, seconds=1.0)


def test_the_memory_of_the_child_is_limited() -> None:
    with Sandbox(memory_bytes=2 * 2**30, seconds=30) as small:
        for function in ("swallow", "swallow_in_mujoco"):
            with pytest.raises(LimitError, match="out of memory"):
                small.call(f"sandboxed:{function}", {"size": 3 * 2**30})
        assert small.call("sandboxed:swallow", {"size": 2**20}) == 2**20


def test_an_unknown_function_is_an_error(sandbox: Sandbox) -> None:
    with pytest.raises(SimulationError, match="has no attribute 'nothing'"):
        sandbox.call("sandboxed:nothing")
    with pytest.raises(SimulationError, match="No module named 'nowhere'"):
        sandbox.call("nowhere:nothing")


def test_the_parent_imports_no_simulator() -> None:
    script = (
        "import sys; from pytest_twin.realization import Sandbox\n"
        "with Sandbox() as s: s.call('math:sqrt', {}) if 0 else None\n"
        "print([m for m in ('mujoco', 'pinocchio', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(("given", "taken"), [(None, "1"), ("3", "3")])
def test_linear_algebra_uses_one_thread_unless_configured_otherwise(
    monkeypatch: pytest.MonkeyPatch, given: str | None, taken: str
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    with Sandbox() as sandbox:
        told = sandbox.call("sandboxed:variable", {"name": "OPENBLAS_NUM_THREADS"})
    assert told == taken


def test_the_child_ends_with_its_parent(importable_functions: Path) -> None:
    folder = str(importable_functions)
    script = (
        f"import os, sys; sys.path.insert(0, {folder!r})\n"
        "from pytest_twin.realization import Sandbox\n"
        "s = Sandbox(); print(s.call('sandboxed:process'), flush=True); os._exit(0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    child = int(done.stdout)
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{child}/stat").read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the child outlived its parent")


def _alive(group: int) -> list[int]:
    """Ids of the running processes of a process group."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, its_group = stat.read_text().rpartition(")")[2].split()[:3]
            if int(its_group) == group and state != "Z":
                found.append(int(stat.parent.name))
    return found


@pytest.mark.parametrize("call", ["spin", "spin_in_forks"])
def test_a_long_call_ends_when_the_parent_is_killed(call: str, importable_functions: Path) -> None:
    program = (
        "from pytest_twin.realization.sandbox import Sandbox\n"
        "sandbox = Sandbox()\n"
        "print(sandbox.call('sandboxed:process'), flush=True)\n"
        f"sandbox.call('sandboxed:{call}', seconds=600)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(importable_functions)}
    parent = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    several = call == "spin_in_forks" and sys.platform == "linux"
    for _ in range(300):
        if len(_alive(child)) == 1 + several:
            break
        time.sleep(0.1)
    else:
        pytest.fail("not all processes of the call started")
    parent.kill()
    parent.wait()
    parent.stdout.close()
    for _ in range(300):
        if not _alive(child):
            break
        time.sleep(0.1)
    else:
        os.killpg(child, signal.SIGKILL)
        pytest.fail("the child kept running after its parent was killed")
