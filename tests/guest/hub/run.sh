# In the guest: the cameras' and serial ports' modules, then hub.py.
modprobe -a uvcvideo vhci-hcd cdc-acm
udevadm settle
cd /shared && exec python3 -u hub.py "$(cat mode)"
