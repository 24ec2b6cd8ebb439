"""The HTML report: one self-contained file, verdict first, names escaped."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from dataclasses import replace

import pytest
from lxml import html as lxml_html

from pytest_twin.outcome import Measure, Outcome, Reason
from pytest_twin.report import html
from pytest_twin.report.model import Entry, Report

HOSTILE = "\"'><script>alert(1)</script><img src=//evil.example/x onerror=alert(1)>{{ 7*7 }}\x1b"


def outcome(name: str, status: str = "passed", error: float = 1e-4, count: int = 2) -> Outcome:
    measures = tuple(
        Measure("position", f"tcp at {i}", 0.1, 0.1, error / (1 + i), 5e-4, "m", "pinocchio")
        for i in range(count)
    )
    return Outcome(
        golden=f"golden/{name}",
        kind="fk",
        realization="mujoco",
        criticality="critical",
        status=status,  # type: ignore[arg-type]
        measures=measures if status != "error" else (),
        error="it diverged at 0.3 s" if status == "error" else None,
        reasons=(Reason("mujoco/mesh:link1", "sha256", "00ff", "11ee"),),
        plot=f".twin/plots/golden/{name}.svg",
        seconds=0.5,
    )


def entry(name: str, status: str = "passed", **options: object) -> Entry:
    error = 2e-3 if status == "failed" else 1e-4
    return Entry(
        outcome(name, status, error), f"Title of {name}", f"golden/{name}.yaml:3", **options
    )  # type: ignore[arg-type]


def report(*entries: Entry, **options: object) -> Report:
    fields: dict[str, object] = {
        "twin": "arm",
        "verdict": "refused",
        "headline": "one critical golden failed",
        "created": "2026-05-04T12:00:00Z",
        "entries": entries,
    }
    return Report(**(fields | options))  # type: ignore[arg-type]


def text_of(page: str) -> str:
    return re.sub(r"\s+", " ", lxml_html.fromstring(page.encode()).text_content())


FULL = report(
    entry("fk/proven", release=2, at="2026-04-01T08:00:00Z", parts=("mujoco/kinematics:a",)),
    entry("fk/passed", plot=b"<svg xmlns='http://www.w3.org/2000/svg'/>"),
    entry("fk/failed", "failed", parts=("mujoco/kinematics:a", "mujoco/mesh:link1")),
    entry("fk/error", "error"),
    refusals=("golden/fk/failed@mujoco: a critical golden failed",),
    notes=("release 1 has expired",),
    previous=2,
    ids={"asset": "00ff", "realizations": {"mujoco": "11ee"}, "payloads": [], "fit": None},
    parts={"mujoco/mesh:link1": "ab" * 32},
    environment={"python": "CPython 3.11.2"},
)


def test_the_report_lists_verdict_then_reasons_then_failures() -> None:
    text = text_of(html.render(FULL))
    places = [
        text.index(words)
        for words in (
            "Refused",
            "one critical golden failed",
            "Why there is no release",
            "golden/fk/failed@mujoco: a critical golden failed",
            "release 1 has expired",
            "Changes since release 2",
            "Title of fk/failed",
            "Title of fk/error",
            "Title of fk/passed",
            "Title of fk/proven",
            "IDs of asset",
            "Environment",
        )
    ]
    assert places == sorted(places)


def test_each_golden_is_shown_with_margin_reason_and_spec_line() -> None:
    text = text_of(html.render(FULL))
    assert "exceeded its tolerance of 0.0005 m by 0.0015 m" in text
    assert "-0.0015 m" in text
    assert "golden/fk/failed.yaml:3" in text
    assert "mujoco/mesh:link1sha25600ff → 11ee" in text
    assert "it diverged at 0.3 s" in text


def test_each_change_is_shown_with_old_and_new_value_and_number_of_goldens() -> None:
    tree = lxml_html.fromstring(html.render(FULL).encode())
    (row,) = tree.xpath("//h2[starts-with(., 'Changes')]/following-sibling::div[1]//tr")
    assert [cell.text_content() for cell in row] == [
        "mujoco/mesh:link1", "sha256", "00ff → 11ee", "3",
    ]  # fmt: skip


def test_a_skipped_golden_names_the_release_that_proves_it() -> None:
    text = text_of(html.render(FULL))
    assert "proven by release 2 on 2026-04-01; nothing that it depends on has changed since" in text


def test_an_unselected_stale_golden_is_shown_as_not_run() -> None:
    left_out = replace(outcome("fk/b", "error"), error="stale, and not run")
    page = html.render(
        report(
            entry("fk/a"),
            Entry(left_out, "Title of fk/b", "golden/fk/b.yaml:3", not_run=True),
            verdict="passed",
        )
    )
    tree = lxml_html.fromstring(page.encode())
    headings = [node.text_content() for node in tree.xpath("//h2")]
    assert "Passed now 1" in headings
    assert "Stale and not run 1; neither passed nor failed" in headings
    assert not any(heading.startswith("Failed") for heading in headings)
    counts = [node.text_content() for node in tree.xpath("//div[contains(@class, 'count ')]")]
    assert counts == ["1passed now", "1not run", "0still proven"]
    assert tree.xpath("//span[@class='tag idle']/text()") == ["not run"]
    assert tree.xpath("//*[contains(@class, 'bad')]") == []


def test_nested_ids_are_shown_as_flat_rows() -> None:
    text = text_of(html.render(FULL))
    assert "realizations / mujoco11ee" in text
    assert "payloadsnone" in text
    assert "fitnone" in text


def test_failed_goldens_are_expanded_and_passed_ones_collapsed() -> None:
    tree = lxml_html.fromstring(html.render(FULL).encode())
    opened = {
        node.xpath("string(.//span[@class='name'])").split("Title")[0]: "open" in node.attrib
        for node in tree.xpath("//details[@class='golden']")
    }
    assert opened == {
        "golden/fk/failed": True,
        "golden/fk/error": True,
        "golden/fk/passed": False,
        "golden/fk/proven": False,
    }


def test_the_report_loads_no_external_resources() -> None:
    page = html.render(FULL)
    tree = lxml_html.fromstring(page.encode())
    assert tree.xpath("//script | //link | //iframe | //object | //embed | //form | //base") == []
    for node in tree.iter():
        for name, value in node.attrib.items():
            assert not name.startswith("on"), (node.tag, name)
            assert name != "style", "the content security policy would block it"
            if name in ("src", "href", "srcset", "action"):
                assert value.startswith("data:image/svg+xml;base64,")
    assert "url(" not in page
    assert "@import" not in page


def test_the_content_security_policy_allows_only_the_inline_style() -> None:
    tree = lxml_html.fromstring(html.render(FULL).encode())
    (policy,) = tree.xpath("//meta[@http-equiv='Content-Security-Policy']/@content")
    (style,) = tree.xpath("//style")
    digest = base64.b64encode(hashlib.sha256(style.text.encode()).digest()).decode()
    assert policy == f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'"


def test_plots_are_embedded_in_the_report() -> None:
    tree = lxml_html.fromstring(html.render(FULL).encode())
    (source,) = tree.xpath("//img/@src")
    assert base64.b64decode(source.partition(",")[2]) == (
        b"<svg xmlns='http://www.w3.org/2000/svg'/>"
    )


def test_malicious_names_are_escaped_in_the_report() -> None:
    odd = replace(
        outcome("x", "failed", 2e-3),
        golden=HOSTILE,
        kind=HOSTILE,
        realization=HOSTILE,
        reasons=(Reason(HOSTILE, HOSTILE, HOSTILE, HOSTILE),),
        measures=(Measure(HOSTILE, HOSTILE, 1.0, 1.0, 2.0, 1.0, HOSTILE, HOSTILE),),
    )
    plain = Outcome("a", "fk", "mujoco", "critical", "error", error=HOSTILE)
    page = html.render(
        report(
            Entry(odd, HOSTILE, HOSTILE, parts=(HOSTILE,), plot=HOSTILE.encode()),
            Entry(plain, HOSTILE, HOSTILE, release=1, at=HOSTILE),
            twin=HOSTILE,
            headline=HOSTILE,
            created=HOSTILE,
            refusals=(HOSTILE,),
            notes=(HOSTILE,),
            expires=HOSTILE,
            key_id=HOSTILE,
            ids={HOSTILE: HOSTILE},
            parts={HOSTILE: HOSTILE},
            environment={HOSTILE: HOSTILE},
        )
    )
    tree = lxml_html.fromstring(page.encode())
    assert tree.xpath("//script") == []
    assert [image for image in tree.xpath("//img/@src") if not image.startswith("data:")] == []
    assert tree.xpath("//*[@onerror]") == []
    assert "\x1b" not in page
    assert "49" not in text_of(page).replace("{{ 7*7 }}", "")


@pytest.mark.parametrize(
    ("verdict", "word", "good"),
    [
        ("released", "Released as release 7", True),
        ("holds", "Still holds", True),
        ("passed", "Passed", True),
        ("failed", "Failed", False),
    ],
)
def test_each_verdict_has_its_own_word_and_colour(verdict: str, word: str, good: bool) -> None:
    options = {"release": 7, "expires": "2026-08-02T12:00:00Z"} if verdict == "released" else {}
    tree = lxml_html.fromstring(html.render(report(verdict=verdict, **options)).encode())
    assert tree.xpath("string(//h1)").strip() == word
    assert ("good" in tree.xpath("string(//header/@class)")) == good


def test_a_report_of_thousands_of_goldens_has_limited_size() -> None:
    big = [
        Entry(outcome(f"fk/{i}", count=30), f"Title {i}", f"g{i}.yaml:1", parts=("p",) * 40)
        for i in range(2000)
    ]
    failed = entry("last", "failed")
    start = time.process_time()
    page = html.render(report(*big, failed))
    assert time.process_time() - start < 20.0
    assert len(page) < 12_000_000
    text = text_of(page)
    assert text.count("Title ") >= 2001
    assert "and 29 more with smaller errors" in text
    # Failed goldens keep their measures when others are shortened.
    assert text.index("Title of last") < text.index("Title 0")


def test_the_total_size_of_plots_is_limited_and_failures_have_priority(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(html, "MAX_PLOT_BYTES", 150)
    page = html.render(
        report(
            entry("passed", plot=b"p" * 100),
            entry("failed", "failed", plot=b"f" * 100),
        )
    )
    tree = lxml_html.fromstring(page.encode())
    (source,) = tree.xpath("//img/@src")
    assert base64.b64decode(source.partition(",")[2]) == b"f" * 100
    assert "the plot is in .twin/plots/golden/passed.svg" in text_of(page)
