"""`haptether try` itself: its refusals."""

import re
from pathlib import Path

import pytest

from haptether.cli.view.trial.command import Try

FOLDER = Path("out")


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (Try(port=70000), "port = 70000: must be 0 to 65535"),
        (Try(delay_s=0.6), "delay_s = 0.6: must be 0 to 0.5"),
        (Try(jitter_s=-0.1), "jitter_s = -0.1: must be 0 to 0.05"),
        (Try(loss=float("nan")), "loss = nan: must be 0 to 0.5"),
        (Try(wall_stiffness=5.0), "wall_stiffness = 5: must be 10 to 1000"),
        (Try(scene="no_scene"), "no_scene"),
        (Try(scene="paper_wall"), "has no [slave]"),
        (Try(scene="remote_push"), "scene = remote_push: has no [operator.aims]"),
        (Try(set=("environment.objects=[]",)), "has no [[environment.objects]]"),
    ],
)
def test_what_cannot_be_is_refused(command: Try, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        command.run()


def test_a_folder_with_files_is_kept(tmp_path: Path) -> None:
    (tmp_path / "notes").touch()
    with pytest.raises(FileExistsError, match="has files already"):
        Try(record=tmp_path).run()
