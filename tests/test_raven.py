"""The attacks of the RAVEN II study: what each does, and that whatever holds, holds still."""

from pathlib import Path

import pytest

from haptether.studies import RAVEN_ATTACKS, RavenReport, RavenRow, raven_suite
from haptether.studies.raven import SECURITY


@pytest.fixture(scope="module")
def report() -> RavenReport:
    return raven_suite()


def rows(report: RavenReport) -> dict[tuple[str, str], RavenRow]:
    return {(row.scene.removeprefix("raven_"), row.security): row for row in report.rows}


def test_every_attack_runs_on_every_kind_of_frames(report: RavenReport) -> None:
    assert len(rows(report)) == len(report.rows) == len(RAVEN_ATTACKS) * len(SECURITY)
    assert {path.stem for path in Path("bridge/scenes").glob("raven_*.toml")} == {one.scene for one in RAVEN_ATTACKS}


def test_each_attack_does_what_it_is_known_to_do(report: RavenReport) -> None:
    assert {key: row.effect for key, row in rows(report).items()} == {
        key: row.expected for key, row in rows(report).items()
    }
    assert report.is_as_expected


def test_whatever_holds_holds_still(report: RavenReport) -> None:
    for row in report.rows:
        assert (row.scene, row.moved_in_hold_mm, row.force_in_hold_n) == (row.scene, 0.0, 0.0)


def test_nobody_succeeds_against_authenticated_frames(report: RavenReport) -> None:
    assert not [row.scene for row in report.rows if row.security == "on" and row.succeeded]
