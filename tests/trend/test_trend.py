"""Command ``pytest-twin trend``: dated recordings, alarms, and inputs that would mislead it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from histories import History, Parameters

from pytest_twin import cli
from pytest_twin.errors import RecordingError, SpecError
from pytest_twin.formats.schema import load_schema
from pytest_twin.report import trend as page
from pytest_twin.trend.trend import follow_files

pytestmark = pytest.mark.usefixtures("commands_in_process")


def trend(folder: Path, paths: list[Path]) -> dict[str, Any]:
    return follow_files(
        {"model": str(folder / "twin.yaml"), "recordings": [str(path) for path in paths]}
    )


def worn(session: int, parameters: Parameters) -> None:
    if session >= 6:
        parameters["elbow.coulomb_friction"] *= 2.0


def test_worn_dry_friction_is_named_with_its_dates_and_its_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = History(change=worn).write(tmp_path)
    out = tmp_path / "out"
    words = [str(tmp_path / "twin.yaml"), *map(str, paths), "--out", str(out), "--json", "-"]
    assert cli.main(["trend", *words]) == 1
    stdout, text = capsys.readouterr()
    document = json.loads(stdout)
    jsonschema.validate(document, load_schema("results/trend.schema.json"))
    assert document == json.loads((out / "trend.json").read_text())
    first = document["changes"][0]
    assert (first["parameter"], first["kind"]) == ("elbow.coulomb_friction", "step")
    assert [date[:10] for date in first["between"]] == ["2026-04-06", "2026-04-13"]
    low, high = first["change"]["ci95"]
    assert low < 0.15 < high
    assert "Alarm: elbow.coulomb_friction" in text
    html = (out / "trend.html").read_text()
    assert "elbow" in html
    assert "http" not in html.replace("http-equiv", "")


def test_nothing_changed_is_no_alarm_and_says_what_would_have_been_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = History(sessions=8).write(tmp_path, 1)
    out = str(tmp_path / "out")
    assert cli.main(["trend", str(tmp_path / "twin.yaml"), *map(str, paths), "--out", out]) == 0
    assert "No alarm" in capsys.readouterr().out
    document = json.loads((tmp_path / "out" / "trend.json").read_text())
    friction = document["parameters"]["elbow.coulomb_friction"]
    assert 0.0 < friction["detectable"] < 0.1
    for value in friction["values"]:
        assert value["value"] == pytest.approx(0.15, abs=0.03)


def test_the_order_of_the_arguments_does_not_matter_and_is_noted(tmp_path: Path) -> None:
    paths = History(change=worn).write(tmp_path)
    mixed = [paths[i] for i in (7, 2, 9, 0, 4, 6, 1, 8, 3, 5)]
    document = trend(tmp_path, mixed)
    dates = [session["date"] for session in document["sessions"]]
    assert dates == sorted(dates)
    assert document["changes"][0]["parameter"] == "elbow.coulomb_friction"
    assert any("ordered by their dates" in note for note in document["notes"])


def test_dates_of_the_metadata_order_logs_whose_clock_starts_at_zero(tmp_path: Path) -> None:
    history = History(
        change=worn, stamped=False,
        metadata=lambda session: {"date": f"{history.date(session):%Y-%m-%dT%H:%M:%S}"},
    )  # fmt: skip
    document = trend(tmp_path, history.write(tmp_path))
    assert document["sessions"][0]["date"] == "2026-03-02T09:00:00+00:00"
    assert any("without a time zone are taken as UTC" in note for note in document["notes"])


def test_times_with_a_zone_are_compared_in_utc(tmp_path: Path) -> None:
    zones = ["+09:00", "-08:00", "Z", "+02:00"]
    history = History(
        sessions=4, stamped=False,
        metadata=lambda session: {"date": f"2026-05-0{session + 1}T23:00:00{zones[session]}"},
    )  # fmt: skip
    document = trend(tmp_path, history.write(tmp_path))
    assert [one["date"] for one in document["sessions"]] == [
        "2026-05-01T14:00:00+00:00", "2026-05-03T07:00:00+00:00", "2026-05-03T23:00:00+00:00",
        "2026-05-04T21:00:00+00:00",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("history", "expected"),
    [
        (History(sessions=5, stamped=False), "no date: its clock counts from its own start"),
        (
            History(sessions=5, stamped=False, metadata=lambda s: {"date": "last week"}),
            "not a date",
        ),
        (History(sessions=5, metadata=lambda s: {"date": "2019-01-01"}), "contradict"),
        (
            History(sessions=5, stamped=False, metadata=lambda s: {"date": f"221{s}-01-01"}),
            "a date in the future",
        ),
        (History(sessions=1), "too few sessions"),
        (History(sessions=3), "too few sessions"),
        (History(sessions=5, metadata=lambda s: {"robot": f"arm{s % 2}"}), "another robot"),
        (
            History(sessions=5, metadata=lambda s: {"payload": "kg1" if s > 2 else "none"}),
            "its mass is not declared",
        ),
    ],
)  # fmt: skip
def test_recordings_without_a_place_in_the_history_are_refused_in_one_line(
    tmp_path: Path, history: History, expected: str
) -> None:
    paths = history.write(tmp_path)
    with pytest.raises(RecordingError, match=expected) as caught:
        trend(tmp_path, paths)
    assert ".csv" in str(caught.value)
    assert "expected" in str(caught.value)


def test_positions_alone_are_refused_with_the_way_out(tmp_path: Path) -> None:
    paths = History(sessions=5).write(tmp_path)
    for path in paths:
        rows = [line.split(",")[:3] for line in path.read_text().splitlines()]
        path.write_text("\n".join(map(",".join, rows)) + "\n")
    with pytest.raises(RecordingError, match="no measured effort") as caught:
        trend(tmp_path, paths)
    assert "--before OLD" in str(caught.value)


def test_two_robots_without_a_name_are_suspected(tmp_path: Path) -> None:
    def other(session: int, parameters: Parameters) -> None:
        if session % 2:
            parameters["elbow.coulomb_friction"] *= 2.0

    document = trend(tmp_path, History(sessions=14, change=other).write(tmp_path))
    assert document["verdict"] == "alarm"
    assert document["mixed"][0]["parameter"] == "elbow.coulomb_friction"
    assert "two robots" in page.mixed_sentence(document["mixed"][0])


def test_friction_that_follows_a_stated_temperature_is_no_ageing(tmp_path: Path) -> None:
    temperature = [18, 20, 19, 21, 20, 19, 36, 38, 35, 37]

    def cold(session: int, parameters: Parameters) -> None:
        for joint in ("lift", "elbow"):
            parameters[f"{joint}.viscous_friction"] *= 1.0 - 0.03 * (temperature[session] - 20)

    stated = History(change=cold, metadata=lambda s: {"temperature": f"{temperature[s]} C"})
    (tmp_path / "stated").mkdir()
    document = trend(tmp_path / "stated", stated.write(tmp_path / "stated"))
    assert document["verdict"] == "no_alarm"
    assert document["declared"] == ["temperature: 18 to 38"]
    (tmp_path / "silent").mkdir()
    assert trend(tmp_path / "silent", History(change=cold).write(tmp_path / "silent"))["changes"]


def test_without_temperatures_a_change_of_the_size_of_the_warm_up_is_no_alarm(
    tmp_path: Path,
) -> None:
    def warms(fraction: float, parameters: Parameters) -> None:
        parameters["elbow.viscous_friction"] *= 1.5 - 0.5 * fraction

    def colder(session: int, parameters: Parameters) -> None:
        if session >= 6:
            parameters["elbow.viscous_friction"] *= 1.2

    history = History(change=colder, during=warms, scatter=0.02)
    document = trend(tmp_path, history.write(tmp_path))
    assert "elbow.viscous_friction" not in [one["parameter"] for one in document["changes"]]
    assert document["parameters"]["elbow.viscous_friction"]["warm_up"] > 0.02
    assert any("no temperatures are recorded" in note for note in document["notes"])


def test_a_declared_event_at_the_change_is_no_alarm(tmp_path: Path) -> None:
    (tmp_path / "twin.yaml").write_text(
        "model: arm.xml\nevents: [{date: 2026-04-10, what: new elbow gearbox}]\n"
    )
    document = trend(tmp_path, History(change=worn).write(tmp_path))
    assert "elbow.coulomb_friction" not in [one["parameter"] for one in document["changes"]]
    assert document["events"] == [
        {"date": "2026-04-10T00:00:00+00:00", "what": "new elbow gearbox"}
    ]
    assert "2026-04-10: new elbow gearbox" in document["declared"]


def test_a_tool_that_the_metadata_state_is_declared(tmp_path: Path) -> None:
    def heavy(session: int, parameters: Parameters) -> None:
        if session >= 5:
            parameters["elbow.m"] += 0.2
            parameters["elbow.mx"] += 0.03

    (tmp_path / "said").mkdir()
    said = History(change=heavy, metadata=lambda s: {"tool": "gripper" if s >= 5 else "none"})
    document = trend(tmp_path / "said", said.write(tmp_path / "said"))
    assert document["verdict"] == "no_alarm"
    assert document["declared"] == ["tool: none"]
    (tmp_path / "silent").mkdir()
    assert trend(tmp_path / "silent", History(change=heavy).write(tmp_path / "silent"))["changes"]


def test_a_copied_recording_counts_once(tmp_path: Path) -> None:
    paths = History(sessions=5).write(tmp_path)
    copy = tmp_path / "copy.csv"
    copy.write_bytes(paths[0].read_bytes())
    document = trend(tmp_path, [*paths, copy])
    left_out = f"left out: {copy}: its measured motion is that of session_00.csv"
    assert left_out in document["notes"]
    assert len(document["sessions"]) == 5


def test_recordings_without_a_pause_are_one_session(tmp_path: Path) -> None:
    class OneMorning(History):
        def date(self, session: int) -> Any:
            return super().date(session // 2).replace(minute=10 * (session % 2))

    document = trend(tmp_path, OneMorning(sessions=10).write(tmp_path))
    assert [len(one["recordings"]) for one in document["sessions"]] == [2] * 5


def test_an_event_without_a_readable_date_is_refused_with_its_line(tmp_path: Path) -> None:
    paths = History(sessions=4).write(tmp_path)
    (tmp_path / "twin.yaml").write_text("model: arm.xml\nevents:\n- {date: soon, what: repair}\n")
    with pytest.raises(SpecError, match="not a date") as caught:
        trend(tmp_path, paths)
    assert "events.0.date" in str(caught.value)


def test_a_fleet_has_a_folder_for_each_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robots = {}
    for name, history in (("worn", History(change=worn)), ("new", History(sessions=8))):
        folder = tmp_path / name
        folder.mkdir()
        files = [f"{name}/{path.name}" for path in history.write(folder, 1)]
        robots[name] = {"model": f"{name}/twin.yaml", "recordings": files}
    (tmp_path / "fleet.yaml").write_text(json.dumps({"robots": robots}))
    out = tmp_path / "out"
    command = ["trend", "--fleet", str(tmp_path / "fleet.yaml"), "--out", str(out), "--jobs", "1"]
    assert cli.main(command) == 1
    document = json.loads((out / "fleet.json").read_text())
    assert document["robots"]["worn"]["verdict"] == "alarm"
    assert document["robots"]["new"]["verdict"] == "no_alarm"
    assert (out / "worn" / "trend.html").is_file()
    assert "trend.html" in capsys.readouterr().out
