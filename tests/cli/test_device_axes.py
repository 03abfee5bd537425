"""A device with another number of axes than its scene is refused before it opens."""

from pathlib import Path

import pytest

from haptether.cli.entry import main

MASTER = """
schema = 1
[master]
device = "inverse3"
driver = "{driver}"
axes = {axes}
[master.options]
{options}
[slave]
"""


@pytest.mark.parametrize(
    "case",
    [("inverse3", "", 1, 3), ("inverse3", 'axes = ["x"]', 3, 1), ("force-dimension", "", 1, 3), ("touch", "", 1, 3)],
)
def test_axes_of_a_driver_are_those_of_its_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], case: tuple[str, str, int, int]
) -> None:
    driver, options, axes, has = case
    scene = tmp_path / "cell.toml"
    scene.write_text(MASTER.format(driver=driver, options=options, axes=axes))
    status = main(["master", "--scene", str(scene), "--peer", "127.0.0.1:9", "--insecure"])
    assert status != 0
    said = " ".join(capsys.readouterr().err.split())
    assert f"master.options: the device has {has} axes, the scene {axes}: must be as many; set axes = {has}" in said
    assert "in [master], or another `axes` in [master.options]" in said


def test_the_refusal_of_a_follower_names_an_option_that_it_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, scene = tmp_path / "arm.toml", tmp_path / "cell.toml"
    arm.write_text('[[servo]]\nid = 1\nmodel = "XM430-W350"\n[[servo]]\nid = 2\nmodel = "XM430-W350"\n')
    scene.write_text(
        'schema = 1\n[master]\nkind = "joints"\naxes = 6\nmass_kg = 0.1\n[slave]\ndevice = "dynamixel"\n'
        f'options = {{ port = "{tmp_path / "port"}", arm = "{arm}" }}\n'
    )
    assert main(["slave", "--scene", str(scene), "--listen", "127.0.0.1:0", "--insecure"]) != 0
    said = " ".join(capsys.readouterr().err.split())
    assert "the arm has 2 axes, the scene 6: must be as many; set axes = 2 in [master], or another `arm` in" in said
    assert "`axes`" not in said
