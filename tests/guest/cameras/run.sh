# In the guest: the modules of the cameras, then cameras.py.
modprobe vivid n_devs=1 node_types=0x1 input_types=0x00
modprobe -a uvcvideo vhci-hcd
udevadm settle
v4l2-ctl -d /dev/video0 --set-ctrl timestamp_source=1 > /dev/null   # else vivid stamps ahead of time
cd /shared && exec python3 -u cameras.py
