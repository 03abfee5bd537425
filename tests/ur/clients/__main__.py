"""What the real ur_rtde does with the emulated controller: one scenario a process, its result as JSON on the last line.

`python -m tests.ur.clients SCENARIO HOST [ARGUMENTS]`. A call of ur_rtde that hangs cannot be interrupted from within,
so whoever runs this has a time-out and kills it.
"""

import json
import os
import sys
from importlib import import_module

from tests.ur.clients.scenario import SCENARIOS

if __name__ == "__main__":
    for module in ("streams", "calls", "stops", "connections"):
        import_module(f"tests.ur.clients.{module}")
    _, name, address, arguments = [*sys.argv, "[]"][:4]
    print(json.dumps(SCENARIOS[name](address, *json.loads(arguments))))
    sys.stdout.flush()
    # Destructors of ur_rtde may wait for threads that wait for the network.
    os._exit(0)
