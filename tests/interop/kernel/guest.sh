#!/bin/sh
# Init of a user-mode-linux guest on the host's own file system: brings vcan0 up, runs one command, powers off.
# The kernel's command line names a folder (robotctl.dir=...) with `command`; `output` and `status` are left there.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/tmp
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /dev/shm 2>/dev/null || { mkdir -p /dev/shm && mount -t tmpfs tmpfs /dev/shm; }
mount -t tmpfs tmpfs /run
dir=$(sed 's/.*robotctl\.dir=\([^ ]*\).*/\1/' /proc/cmdline)
modules=/usr/lib/uml/modules/$(uname -r)/kernel
for module in net/can/can.ko net/can/can-raw.ko drivers/net/can/dev/can-dev.ko net/sched/sch_plug.ko; do
    insmod "$modules/$module"
done
insmod "$modules/drivers/net/can/vcan.ko" echo=1 # tells what has left once it has, as hardware does
ip link set lo up
ip link add dev vcan0 type vcan
ip link set vcan0 mtu 72 up
sh "$dir/command" >"$dir/output" 2>&1
echo $? >"$dir/status"
sync
echo o >/proc/sysrq-trigger
sleep 10
