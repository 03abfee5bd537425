"""A window driven by events of its toolkit: `python -m tests.view.steered`, on a display.

It prints as JSON, for each event, its name and the state of the window after it.
"""

import json
import sys
import time

from tests.view.shown import shown

from haptether.view.window.playback import Playback

KEYS = ("space", "space", "Home", "Right", "Left", "Up", "Down", "Down", "End", "t", "1", "2", "3", "4",
        "question", "question", "x", "q")  # fmt: skip
AT_S = 2.0


def main() -> None:
    """Press every key once, click, and play."""
    window = Playback([shown("remote_push")[2]], size=(560, 340), camera="front", at_s=AT_S)
    window.draw()
    interactor = window.picture.plotter.iren.interactor
    rows = []

    def note(event: str) -> None:
        player, text = window.player, window.picture.plotter.renderers[0].actors.get("keys")
        rows.append(
            {
                "event": event,
                "time_s": player.time_s,
                "playing": player.is_playing,
                "speed": player.speed,
                "camera": window.picture.camera,
                "keys": "" if text is None else text.GetText(2),
                "closed": window.is_closed,
            }
        )

    note("opened")
    for number, key in enumerate(KEYS):
        interactor.SetKeyEventInformation(0, 0, "\0", 0, key)
        interactor.InvokeEvent("KeyPressEvent")
        note(key)
        if number == 0:
            time.sleep(0.05)
            interactor.InvokeEvent("TimerEvent")
            note("timer")
    width, _ = window.picture.size
    interactor.SetEventInformation(width // 4, 10)
    interactor.InvokeEvent("LeftButtonPressEvent")
    interactor.InvokeEvent("LeftButtonReleaseEvent")
    note("click")
    json.dump(rows, sys.stdout)


if __name__ == "__main__":
    main()
