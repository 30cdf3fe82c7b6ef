# In the guest: two radios of mac80211_hwsim, the second one's in a namespace of its own, then wifi.py.
modprobe mac80211_hwsim radios=2
udevadm settle
ip netns add station
iw phy "$(cat /sys/class/net/wlan1/phy80211/name)" set netns name station
ip -n station link set lo up
cd /shared && exec python3 -u wifi.py
