"""Ask a server for grasps over both transports; prints milliseconds, for docker/test_image.sh.

usage: python docker/ask.py HTTP_URL GRPC_ADDRESS [REQUESTS]
"""

import json
import statistics
import sys
import time

import numpy as np

from edgegrasp_client import GraspClient

random = np.random.default_rng(0)
table = random.uniform((0.0, 0.0, 0.0), (0.3, 0.3, 0.001), (10_000, 3))
boxes = [
    corner + random.uniform(0.0, 1.0, (2000, 3)) * (0.03, 0.05, 0.06)
    for corner in random.uniform((0.03, 0.03, 0.0), (0.2, 0.2, 0.001), (5, 3))
]
cloud = np.concatenate([table, *boxes]).astype(np.float32)

found = {}
for address in sys.argv[1:3]:
    with GraspClient(address) as client:
        client.wait_until_ready()
        seconds = []
        for _ in range(int((sys.argv[3:] or ["12"])[0])):
            start = time.perf_counter()
            grasps = client.detect(cloud, viewpoint=(0.15, 0.15, 0.7), num_candidates=500).grasps
            seconds.append(time.perf_counter() - start)
            assert grasps, "no grasps"
    name = "rest" if address.startswith("http") else "grpc"
    found[name] = round(statistics.median(seconds) * 1000, 1)
print(json.dumps(found))
