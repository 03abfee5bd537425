"""Progress on standard error: nothing for two seconds, then the completed share."""

import re
import time
from collections.abc import Callable

import pytest

from haptether.cli.entry import main
from haptether.cli.shared import progress

Progress = Callable[[int, int], None]


@pytest.mark.parametrize(
    ("arguments", "text", "of"),
    [(["paper"], "experiments", 6), (["raven"], "attacks", 24), (["paper", "--sensitivity"], "sensitivity", 7)],
)
@pytest.mark.parametrize("is_long", [True, False])
def test_a_command_that_takes_long_shows_how_much_is_done(
    *,
    arguments: list[str],
    text: str,
    of: int,
    is_long: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from haptether import studies

    def stand_in(name: str) -> object:
        real = getattr(studies, name)

        def slow(*given: object, progress: Progress, **how: object) -> object:
            found = real(*given, **how) if name != "paper_sensitivity" else given[0]
            for done in range(1, of + 1):
                progress(done, of)
            if is_long:
                time.sleep(0.2)
            return found

        return slow

    for name in ("reproduce_paper", "raven_suite", "paper_sensitivity"):
        monkeypatch.setattr(studies, name, stand_in(name), raising=False)
    monkeypatch.setattr(progress, "AFTER_S", 0.05 if is_long else 60.0)
    assert main(arguments) == 0
    said = capsys.readouterr()
    assert bool(re.search(rf"{text}.*{of}/{of}", said.err)) == is_long
    assert f" {of}/{of} " not in said.out


@pytest.mark.parametrize(("name", "of"), [("raven_suite", 24), ("reproduce_paper", 6)])
def test_a_study_counts_what_is_done(name: str, of: int) -> None:
    from haptether import studies

    seen: list[tuple[int, int]] = []
    getattr(studies, name)(progress=lambda done, of: seen.append((done, of)))
    assert seen == [(done, of) for done in range(1, of + 1)]
