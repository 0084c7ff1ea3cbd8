#!/bin/sh
# Inside namespaces of our own: this folder becomes /mnt, its tmp becomes /tmp (LinuxCNC keeps a lock
# file there), and our HAL components join those that LinuxCNC finds. Nothing of it is seen outside.
set -e
modules=/usr/lib/linuxcnc/modules
mkdir -p theirs modules tmp
mount --bind "$PWD" /mnt
cd /mnt
mount --bind "$modules" theirs
for file in theirs/*.so; do ln -sf "/mnt/$file" modules/; done
for file in components/*.so; do ln -sf "/mnt/$file" modules/; done
mount --bind modules "$modules"
mount --bind tmp /tmp
ip link set lo up
ip -o link | cut -d: -f2 > networks.txt
export HOME=/mnt RTAPI_FIFO_PATH=/mnt/rtapi.fifo
exec "$@"
