"""A child that dies over the second file and hangs over the fourth."""

from __future__ import annotations

import json
import os
import signal
import sys

if __name__ == "__main__":
    for line in sys.stdin:
        _, _, first, count = json.loads(line)
        print("ready", flush=True)
        for index in range(first, first + count):
            if index == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            while index == 3:
                pass
            print(json.dumps({"index": index, "case": "x", "end": "read", "seconds": 0, "mb": 0}), flush=True)
