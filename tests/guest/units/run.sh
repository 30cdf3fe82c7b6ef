# In the guest, whose first process is systemd: the package's files are there, its service runs confined. Each
# finding is a line "name: value" in /shared/report.txt; the host's test judges them. /dev/vdb is the package's
# content: unpacking it takes an emulated processor minutes, and is tested where it takes seconds
# (tests/test_package.py).
cd /shared
report=/shared/report.txt; : > $report
say() { echo "$1: $2" >> $report; }
unset PYTHONPATH
now() { echo $(($(date +%s%N) / 1000000)); }
since() { echo "$(($(now) - $1)) ms"; }
modprobe vivid n_devs=1 2> /dev/null
mkdir -p /package /usr/lib/vad && mount -o ro /dev/vdb /package && mount --bind /package/usr/lib/vad /usr/lib/vad
for file in $(cd /package && find usr -path usr/lib/vad -prune -o ! -type d -print); do
    mkdir -p "/$(dirname "$file")" && cp -P "/package/$file" "/$file"
done
systemd-sysusers vad.conf; systemd-tmpfiles --create vad.conf
udevadm control --reload; udevadm trigger --action=change; udevadm settle
say "groups" "$(id -nG vad | tr ' ' '\n' | sort | paste -sd ' ')"
say "camera" "$(stat -c '%U:%G %a' /dev/video0)"

# Confined as the daemon is: what it does more rarely (probe.py). The default route is there for one packet.
ip link add home type dummy && ip addr add 192.168.7.1/24 dev home && ip link set home up
ip route add default via 192.168.7.2
sed 's|^Type=.*|Type=oneshot|; s|^ExecStart=.*|ExecStart=/usr/lib/vad/bin/python -I /shared/probe.py|
    s|^TimeoutStartSec=.*|TimeoutStartSec=600|; /^ConditionPath/d; /^Watchdog/d; /^ExecReload/d; /^CPUQuota/d; /^Restart/d' \
    /usr/lib/systemd/system/vad.service > /etc/systemd/system/probe.service
systemctl daemon-reload; systemctl start probe; say "probed" "$?"
journalctl -u probe --no-pager -o cat > probe.txt

# An emulated processor is some ten times slower than a hub's.
slow() { printf '[Service]\nCPUQuota=\nTimeoutStartSec=600\nTimeoutStopSec=20\nWatchdogSec=%s\nTimeoutAbortSec=%s\n' "$1" "$2"; }
mkdir -p /etc/systemd/system/vad.service.d
slow 180 20 > /etc/systemd/system/vad.service.d/slow.conf
systemctl daemon-reload
say "verify" "$(systemd-analyze verify vad.service vad-agent.service 2>&1 | paste -sd ' ')"
systemctl start vad; say "without settings" "$(systemctl is-active vad) $(systemctl is-failed vad)"

cp vad.yaml /etc/vad/vad.yaml; chmod 640 /etc/vad/vad.yaml
say "settings" "$(stat -c '%U:%G %a' /etc/vad/vad.yaml)"
t=$(now); systemctl start vad; say "started" "$?"; say "start took" "$(since $t)"
pid=$(systemctl show vad -p MainPID --value)
say "user" "$(stat -c %U /proc/$pid)"
for key in NoNewPrivs Seccomp CapEff CapBnd; do say "$key" "$(awk -v k=$key: '$1 == k {print $2}' /proc/$pid/status)"; done
vad status --json > status.json 2> status.err; say "status" "$?"
say "memory" "$(systemctl show vad -p MemoryCurrent --value)"
say "tasks" "$(systemctl show vad -p TasksCurrent --value)"
say "store" "$(stat -c '%U:%G %a' /var/lib/vad/vad.sqlite)"
say "run" "$(stat -c '%U:%G %a' /run/vad)"
# In the service's place: what must not be written, seen or spoken to, and what must.
inside() { nsenter -t $pid -m setpriv --reuid vad --regid vad --clear-groups sh -c "$1" > /dev/null 2>&1; echo $?; }
say "writes its state" "$(inside 'touch /var/lib/vad/x && rm /var/lib/vad/x')"
say "writes settings" "$(nsenter -t $pid -m sh -c 'touch /etc/vad/x' 2> /dev/null; echo $?)"
say "writes programs" "$(nsenter -t $pid -m sh -c 'touch /usr/bin/x' 2> /dev/null; echo $?)"

echo "robot: {type: neato, prot: x}" > /etc/vad/vad.yaml
systemctl reload vad 2> /dev/null; say "broken reload" "$?"
say "after it" "$(systemctl is-active vad) $([ "$(systemctl show vad -p MainPID --value)" = $pid ] && echo same)"
# With a floor plan it does not wait for the robot's: camera, card and access point are opened.
cp floor.* /etc/vad/; sed 's/^map:/map: {file: floor.yaml}/' vad.yaml > /etc/vad/vad.yaml
systemctl reload vad; say "good reload" "$?"
t=$(now); until vad status --json > status-reloaded.json 2> /dev/null || [ $(($(now) - t)) -gt 240000 ]; do
    grep -q '"part": "csi' status-reloaded.json && break
done
say "after that" "$(systemctl is-active vad) $([ "$(systemctl show vad -p MainPID --value)" = $pid ] && echo same)"

# Stopped in its tracks: nothing feeds the watchdog.
slow 10 2 > /etc/systemd/system/vad.service.d/slow.conf
systemctl daemon-reload; systemctl restart vad; pid=$(systemctl show vad -p MainPID --value)
kill -STOP $pid; t=$(now)
while [ -e /proc/$pid/stat ] && [ $(($(now) - t)) -lt 120000 ]; do sleep 0.2; done
say "watchdog bit after" "$(since $t)"
slow 180 20 > /etc/systemd/system/vad.service.d/slow.conf; systemctl daemon-reload
t=$(now); until [ "$(systemctl is-active vad)" = active ] || [ $(($(now) - t)) -gt 240000 ]; do sleep 1; done
say "then" "$(systemctl is-active vad) restarts $(systemctl show vad -p NRestarts --value)"

vad install > install.txt 2>&1; say "vad install" "$?"
say "allowed" "$(systemctl show vad -p IPAddressAllow --value)"
say "devices" "$(systemctl show vad -p DeviceAllow --value | sort | paste -sd ' ')"
journalctl -u vad --no-pager -o cat > journal.txt
