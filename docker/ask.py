"""Ask a server for grasps over both transports; prints milliseconds, for docker/test_image.sh.

usage: python docker/ask.py HTTP_URL GRPC_ADDRESS [REQUESTS]
"""

import json
import statistics
import sys
import time
from pathlib import Path

import edgegrasp_service
from edgegrasp_client import DepthImage, GraspClient

SAMPLE = Path(edgegrasp_service.__file__).parent / "playground" / "samples" / "depth.png"
image: DepthImage = {"depth": SAMPLE, "intrinsics": (540, 540, 320, 239)}

found = {}
for address in sys.argv[1:3]:
    with GraspClient(address) as client:
        client.wait_until_ready()
        seconds = []
        for _ in range(int((sys.argv[3:] or ["12"])[0])):
            start = time.perf_counter()
            grasps = client.detect(depth_images=[image]).grasps
            seconds.append(time.perf_counter() - start)
            assert grasps, "no grasps"
    name = "rest" if address.startswith("http") else "grpc"
    found[name] = round(statistics.median(seconds) * 1000, 1)
print(json.dumps(found))
