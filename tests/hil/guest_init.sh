#!/bin/sh
# First process of the User Mode Linux guest; `HIL_JOB` (kernel command line) is the folder on the
# host that holds `job`, the script to run, and takes `status`, its exit status.
export PATH=/usr/local/bin:/usr/bin:/bin:/usr/local/sbin:/usr/sbin:/sbin
status=125

mount -t proc proc /proc
mount -t sysfs sysfs /sys
grep -q ' /dev devtmpfs ' /proc/mounts || mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts devpts /dev/pts
mount -t tmpfs shm /dev/shm
mount -t tmpfs run /run
mount -t tmpfs tmp "$HIL_JOB/tmp"

sh "$HIL_JOB/job" 2>&1
status=$?

# Written beside and renamed: a status file is whole or absent.
echo "$status" >"$HIL_JOB/status.part" && mv "$HIL_JOB/status.part" "$HIL_JOB/status"
sync
echo o >/proc/sysrq-trigger # power off; init must not return
sleep 60
