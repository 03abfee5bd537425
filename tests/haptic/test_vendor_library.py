"""Search for a vendor's library, and the messages if it is missing."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from tests.haptic.standins import built

from haptether.bridge import load_master
from haptether.checklist import RefusedError

pytestmark = pytest.mark.live

PLACES = {
    "force-dimension": ("force_dimension/dhd.c", "FDSDK", "libdrd.so.3", "https://www.forcedimension.com/software/sdk"),
    "touch": ("touch/hd.c", "OH_SDK_BASE", "libHD.so", "https://support.3dsystems.com"),
}


def refusal(driver: str, **options: Any) -> str:  # noqa: ANN401  # options of the driver
    with pytest.raises(RefusedError) as refused:
        load_master(driver, options).open()
    return str(refused.value)


@pytest.mark.parametrize("driver", PLACES)
def test_one_error_says_where_it_was_looked_for_and_where_it_is_had(
    driver: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    _, variable, name, where = PLACES[driver]
    monkeypatch.delenv(variable, raising=False)
    said = refusal(driver)
    for part in (f"looked for {name}", "/usr/local/lib/", f"{variable} is not set", where, "option library"):
        assert part in said
    told = capfd.readouterr().err.splitlines()
    assert [line.startswith(f"{driver}: REFUSED  library: no ") for line in told] == [True]


@pytest.mark.parametrize("driver", PLACES)
def test_the_option_is_the_only_place_where_it_is_given(driver: str, tmp_path: Path) -> None:
    said = refusal(driver, library=str(tmp_path / "none.so"))
    assert f"looked for {tmp_path / 'none.so'}: install" in said
    (tmp_path / "text.so").write_text("no library")
    assert "text.so (" in refusal(driver, library=str(tmp_path / "text.so"))


@pytest.mark.parametrize(
    ("driver", "below"),
    [("force-dimension", "lib/release/lin-{machine}-gcc/libdrd.so.3.17.5"), ("touch", "usr/lib/libHD.so.3.4.0")],
)
def test_it_is_found_below_the_folder_of_the_environment(
    driver: str, below: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import platform

    source, variable, _, _ = PLACES[driver]
    file = tmp_path / "kit" / below.format(machine=platform.machine())
    file.parent.mkdir(parents=True)
    shutil.copy(built(source, tmp_path), file)
    monkeypatch.setenv(variable, str(tmp_path / "kit"))
    device = load_master(driver, {})
    device.open()
    device.close()
    assert f"{driver}: ok       library: {file}" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("driver", "flag", "lacks"),
    [
        ("force-dimension", "-DWITHOUT_WATCHDOG", "dhdSetWatchdog"),
        ("touch", "-DWITHOUT_UNSCHEDULE", "hdUnschedule"),
    ],
)
def test_a_library_that_lacks_a_function_is_refused_before_a_device_is_opened(
    driver: str, flag: str, lacks: str, tmp_path: Path
) -> None:
    path = built(PLACES[driver][0], tmp_path, flag)
    assert f"library: {path} has no {lacks}: install" in refusal(driver, library=str(path))
