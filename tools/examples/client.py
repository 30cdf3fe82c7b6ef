#!/usr/bin/env python3
"""Where everything is, how sure that is, and what happens from now on: the plain Python client.

python tools/examples/client.py [ENDPOINT]
"""

import sys

from vad.client import VadClient

endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
with VadClient(endpoint) as client:
    for device in client.devices(state="mapped", max_sigma_m=0.5):
        print(f"{device.name or device.mac}: {device.room}, x {device.x_m:.2f} m, y {device.y_m:.2f} m")
        heatmap = client.heatmap_array(device.mac)  # (height, width), row 0 at the lowest y, sums to 1
        if heatmap is not None:
            print(f"  the likeliest cell holds {heatmap.max():.1%}")
    for event in client.recent_events():
        print(f"{event.published_at} {event.text}")
    print("from now on:", flush=True)
    for event in client.events():
        print(event.text, flush=True)
