"""Diagnose blind cases, each in a process that can read only its case folder.

    python benchmarks/concealed/run.py --cases DIR --out DIR [--seconds 600] [--jobs 2] [--cores 1]
        [--joints 6]

Writes DIR/<case>/diagnosis.json and the output of the command. If the kernel supports it, the
command cannot read any other file (``confine.py``); the record of the run states whether this was
enforced. Each case has its own cores, so that its wall time can be compared with the engine's. The
time of all cases is printed at the end. A second run continues the first one. The order is
independent of the hidden effects, so the finished cases of an incomplete run are a random sample.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from xml.etree import ElementTree

import psutil
from confine import confinable

CONFINE = Path(__file__).with_name("confine.py")


def diagnose(
    case: Path, out: Path, seconds: float, cores: Sequence[int] = (), cpu_seconds: int = 0,
    ends_after: float | None = None, interrupted_after: float | None = None,
) -> dict[str, object]:  # fmt: skip
    """Run the command on one case, on some cores or all; return status, wall time and last output.

    ``cpu_seconds`` limits the processor time, which does not depend on the load of the machine; 0
    for no limit. A process that reaches it is killed. ``ends_after`` is the time limit of the
    diagnosis, s, after which it ends with its best result; None for its default.
    ``interrupted_after`` is the processor time, s, after which the command is interrupted as by
    Ctrl-C, with the same effect; None for never.
    """
    case, out = case.resolve(), out.resolve()
    box = out.with_name(f"{out.name}.box")
    shutil.rmtree(box, ignore_errors=True)
    box.mkdir(parents=True)
    confined = confinable()
    command = [
        *(("taskset", "--cpu-list", ",".join(map(str, cores))) if cores else ()),
        *(("prlimit", f"--cpu={cpu_seconds}") if cpu_seconds else ()),
        *((sys.executable, str(CONFINE), "--read", str(case), "--write", str(box), "--")
          if confined else ()),
        str(Path(sys.executable).with_name("pytest-twin")), "diagnose", "--seconds", "0",
        str(model_of(case)),
        *sorted(str(path) for path in (case / "recordings").glob("*.mcap")),
        *before_of(case),
        "--out", str(box / "said"),
        *(() if ends_after is None else ("--seconds", str(ends_after))),
    ]  # fmt: skip
    told: dict[str, object] = {"case": case.name, "confined": confined}
    environment = {**os.environ, "TMPDIR": str(box), "HOME": str(box)}
    start, worked = time.perf_counter(), processor_seconds()
    try:
        child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=case,
            env=environment,
        )  # fmt: skip
        if interrupted_after is not None:
            Thread(target=interrupt, args=(child, interrupted_after), daemon=True).start()
        try:
            _, stderr = child.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            child.kill()
            child.communicate()
            return {**told, "status": "timeout", "seconds": seconds}
        told["cpu_seconds"] = processor_seconds() - worked
        taken = time.perf_counter() - start
        if (box / "said").exists():
            shutil.rmtree(out, ignore_errors=True)
            (box / "said").rename(out)
    finally:
        shutil.rmtree(box, ignore_errors=True)
    return {**told, "status": child.returncode, "seconds": taken, "stderr": stderr[-2000:]}


def interrupt(child: subprocess.Popen[str], after: float) -> None:
    """Interrupt a command when its processes have used ``after`` s of processor time."""
    while child.poll() is None:
        with suppress(psutil.NoSuchProcess):
            whole = psutil.Process(child.pid)
            times = [p.cpu_times() for p in (whole, *whole.children(recursive=True))]
            if (
                sum(t.user + t.system for t in times)
                + sum(t.children_user + t.children_system for t in times)
                >= after
            ):
                child.send_signal(signal.SIGINT)
                return
        time.sleep(0.5)


def model_of(case: Path) -> Path:
    """Return ``twin.yaml`` of a case if its recordings differ in the controller, else its model."""
    twin = case / "twin.yaml"
    return twin if twin.exists() else case / "model.xml"


def before_of(case: Path) -> list[str]:
    """Return the options for the recordings of an earlier session, if the case has one."""
    earlier = sorted(str(path) for path in (case / "before" / "recordings").glob("*.mcap"))
    return ["--before", *earlier] if earlier else []


def processor_seconds() -> float:
    """Processor time of all ended commands, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def answer(
    case: Path, out: Path, seconds: float, free: SimpleQueue[list[int]], cpu_seconds: int = 0,
    ends_after: float | None = None, interrupted_after: float | None = None,
) -> float:  # fmt: skip
    """Diagnose a case on the next free cores, print a line, and return the time, s."""
    cores = free.get()
    try:
        told = diagnose(
            case, out / case.name, seconds, cores, cpu_seconds, ends_after, interrupted_after
        )
    finally:
        free.put(cores)
    (out / f"{case.name}.run.json").write_text(json.dumps(told, indent=1) + "\n")
    print(case.name, told["status"], f"{told['seconds']:.0f} s", flush=True)
    return float(str(told["seconds"]))


def joints(model: Path) -> int:
    """Return the number of joints of a case's model."""
    return sum(1 for _ in ElementTree.parse(model).getroot().iterfind("worldbody//joint"))


def main() -> None:
    """Diagnose every case of a folder that has no result yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--cpu-seconds", type=int, default=0, help="of each process; 0: no limit")
    parser.add_argument("--ends-after", type=float, help="--seconds of the diagnosis itself")
    parser.add_argument(
        "--interrupted-after", type=float, help="s of processor time, then as by Ctrl-C"
    )
    parser.add_argument("--jobs", type=int, default=2, help="cases at the same time")
    parser.add_argument("--cores", type=int, default=1, help="of each case")
    parser.add_argument("--joints", type=int, help="cases of so many alone")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    open_cases = [
        path.parent for path in sorted(args.cases.glob("*/model.xml"))
        if not (args.out / f"{path.parent.name}.run.json").exists()
        and args.joints in (None, joints(path))
    ]  # fmt: skip
    random.Random(0).shuffle(open_cases)
    every = sorted(os.sched_getaffinity(0))
    free: SimpleQueue[list[int]] = SimpleQueue()
    for first in range(0, min(args.jobs * args.cores, len(every)), args.cores):
        free.put(every[first : first + args.cores])
    with ThreadPoolExecutor(free.qsize()) as pool:
        one = partial(answer, out=args.out, seconds=args.seconds, free=free,
                      cpu_seconds=args.cpu_seconds, ends_after=args.ends_after,
                      interrupted_after=args.interrupted_after)  # fmt: skip
        # After an error or interruption, no further cases are started.
        seconds = list(pool.map(one, open_cases))
    if seconds:
        print(f"median of {len(seconds)}: {statistics.median(seconds):.0f} s, at most "
              f"{max(seconds):.0f} s")  # fmt: skip


if __name__ == "__main__":
    main()
