"""Picture of the page of `haptether try` for its documentation: after two releases at the wall.

python -m tests.view.trial.screenshot docs/images/try.png
"""

import subprocess
import sys

from tests.view.console.browser import chromium, hold
from tests.view.trial.pointer import press_in, throw


def main(path: str) -> None:
    """Write a PNG of a hand that presses again after two releases."""
    with subprocess.Popen([sys.executable, "-m", "haptether", "try"], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        address = server.stdout.readline().split()[-1]
        with chromium() as browser:
            page = browser.new_page(viewport={"width": 1366, "height": 768})
            page.goto(address)
            page.wait_for_selector("#pair-right .facts")
            page.wait_for_timeout(3e3)
            hold(page, 1.4)
            page.wait_for_selector("#pair-right .engaged")
            for depth in (-0.03, -0.045):
                throw(page, depth)
            press_in(page, 0.02, -0.04, 0.8)
            page.wait_for_timeout(300)
            page.screenshot(path=path)
        server.terminate()


if __name__ == "__main__":
    main(sys.argv[1])
