"""Picture of the console for its documentation: a push reaches a hand that has let go.

python -m tests.view.console.screenshot docs/images/console.png
"""

import subprocess
import sys

from tests.view.console.browser import chromium, hold


def main(path: str) -> None:
    """Write a PNG of a running scene."""
    with subprocess.Popen(
        [sys.executable, "-m", "haptether", "console", "--scene", "remote_push"], stdout=subprocess.PIPE, text=True
    ) as console:
        assert console.stdout is not None
        address = console.stdout.readline().split()[-1]
        with chromium() as browser:
            page = browser.new_page(viewport={"width": 1280, "height": 1320})
            page.goto(address)
            page.wait_for_selector("#side-slave .headline")
            page.wait_for_timeout(4e3)
            hold(page, 1.3)
            # The controller trips when the hand lets go.
            page.wait_for_selector("#side-master .tripped")
            page.wait_for_timeout(700)
            page.screenshot(path=path)
        console.terminate()


if __name__ == "__main__":
    main(sys.argv[1])
