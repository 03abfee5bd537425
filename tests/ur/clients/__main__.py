"""The real ur_rtde against the emulated controller: one scenario per process, its result as JSON on the last line.

`python -m tests.ur.clients SCENARIO HOST [ARGUMENTS]`. A hanging call of ur_rtde cannot be interrupted from within, so
the caller needs a timeout and kills the process.
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
