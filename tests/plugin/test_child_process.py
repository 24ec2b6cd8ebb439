"""The process that runs goldens: crashes, its time limit, and code that changes."""

from __future__ import annotations

import os
import time


def test_a_crash_fails_only_the_golden_that_crashed(recorded) -> None:
    codes = {
        "a_abort": "import os; os.abort()",
        "b_exit": "import os; os._exit(3)",
        "c_raise": "raise ValueError('no such gripper')",
    }
    for name in codes:
        recorded.task(name, "return {'reach': 1.0}")
    recorded.write("golden/zz.yaml", (recorded.root / "golden/fk/home.yaml").read_text())
    assert recorded.run("--twin-update", "-k", "a_ or b_ or c_").ret == 0
    for name, code in codes.items():
        recorded.write(f"{name}.py", f"def run(realization):\n    {code}\n")
    result = recorded.run()
    result.assert_outcomes(passed=3, failed=3)
    result.stdout.fnmatch_lines(
        [
            "golden/task/a_abort@mujoco: the simulator crashed (SIGABRT)*",
            "golden/task/b_exit@mujoco: the child process ended with exit status 3*",
            "golden/task/c_raise@mujoco: *c_raise.py:2: ValueError: no such gripper*",
        ]
    )


def test_a_task_changed_within_the_same_second_runs_in_its_new_form(recorded) -> None:
    """Bytecode of Python is cached by time and size of the source, which may both be equal."""
    recorded.task("reach", "return {'reach': 1.0}")
    file = recorded.root / "reach.py"
    assert recorded.run("--twin-update", "-k", "reach").ret == 0
    before = file.stat()
    file.write_text(file.read_text().replace("1.0", "2.0"))
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    recorded.run("-k", "reach").assert_outcomes(failed=1)


def test_only_the_golden_that_exceeds_the_timeout_fails(recorded) -> None:
    recorded.task("long", "return {'reach': 1.0}")
    start = time.monotonic()
    assert recorded.run("--twin-update", "-k", "long").ret == 0
    # Long enough to start a process and run the other goldens, on a busy machine too.
    limit = max(4, round(4 * (time.monotonic() - start)))
    code = f"import time\ndef run(realization):\n    time.sleep({20 * limit})\n"
    recorded.write("long.py", code)
    start = time.monotonic()
    result = recorded.run("--twin-timeout", str(limit))
    assert time.monotonic() - start < 5 * limit
    result.assert_outcomes(passed=2, failed=1)
    result.stdout.fnmatch_lines([f"*exceeded its time limit and was killed*at most {limit} s*"])
