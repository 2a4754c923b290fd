#!/bin/sh
# First process of a guest that becomes systemd; `guest_init.sh` says what HIL_JOB is.
# HIL_KEEP: folders of the host, colons between, that stay visible.
#
# A boot cleans and fills /tmp, /var, /etc: never the host's. The kernel mounts the host's tree
# read-only; that is tried here, and nothing boots where it is not so. systemd then gets a root in
# memory, and the host's is unmounted: what is left of the host is /usr and HIL_KEEP, read-only, and
# the job's own folder.
export PATH=/usr/local/bin:/usr/bin:/bin:/usr/local/sbin:/usr/sbin:/sbin

refuse() {
    echo "guest: $1" >&2
    echo o >/proc/sysrq-trigger # power off; init must not return
    while :; do sleep 60; done
}

mount -t proc proc /proc || exit # the kernel panics: better than to go on without a way to refuse
grep -q '^[^ ]* / hostfs ro[, ]' /proc/mounts || refuse "the host's tree is not mounted read-only"
for folder in / /etc /home /opt /root /tmp /usr /var /var/tmp "$HIL_JOB"; do
    probe=$folder/.hil-probe-$$
    if (: >"$probe") 2>/dev/null; then
        rm -f "$probe"
        refuse "$folder of the host can be written to"
    fi
done

# The new root.
mount -t tmpfs -o mode=755 run /run && root=/run/root && mkdir $root &&
    mount -t tmpfs -o mode=755 root $root && cd $root || refuse "no root in memory"
mkdir dev etc host home mnt opt proc root run srv sys tmp usr var var/lib var/log var/tmp
chmod 1777 tmp var/tmp
for entry in /bin /lib /lib32 /lib64 /libx32 /sbin; do
    [ ! -L $entry ] || cp -a $entry .
    [ -L $entry ] || [ ! -d $entry ] || { mkdir ".$entry" && mount --bind $entry ".$entry"; }
done
mount --bind /usr usr
cp -a /etc/. etc/ 2>/dev/null # a caller who is not root may not read all of it
IFS=:
for folder in $HIL_KEEP; do mkdir -p ".$folder" && mount --bind "$folder" ".$folder"; done
unset IFS
mkdir -p ".$HIL_JOB" && mount -t hostfs -o "$HIL_JOB" job ".$HIL_JOB" || refuse "no folder of the job"
mount -t tmpfs -o mode=1777 tmp ".$HIL_JOB/tmp"
mount -t proc proc proc && mount -t sysfs sysfs sys && mount -t devtmpfs dev dev &&
    mount -t tmpfs -o mode=755 run run || refuse "no kernel file systems"

# What a vehicle computer does at boot, less what this guest has no use for. No fstab: nothing is
# mounted or mounted anew. Updates after a change of /usr are none of the boot's business here, so
# that users are made by the installation that is under test.
: >etc/fstab
touch -r /usr etc/.updated var/.updated
units=etc/systemd/system
rm -rf $units etc/systemd/network etc/udev/rules.d etc/modules-load.d
mkdir -p $units etc/systemd/network etc/udev/rules.d
for unit in modprobe@.service proc-sys-fs-binfmt_misc.automount systemd-firstboot.service \
    systemd-random-seed.service systemd-remount-fs.service systemd-sysctl.service \
    systemd-tmpfiles-clean.timer systemd-tmpfiles-clean.service systemd-tmpfiles-setup.service \
    systemd-tmpfiles-setup-dev.service systemd-udev-trigger.service systemd-update-utmp.service; do
    ln -s /dev/null "$units/$unit"
done
rm -f etc/machine-id
systemd-machine-id-setup --root=$root >/dev/null 2>&1

cat >$units/hil.service <<UNIT
[Unit]
Description=the job of the host
Wants=basic.target
After=basic.target
[Service]
Environment=HIL_JOB=$HIL_JOB TERM=dumb PATH=$PATH
ExecStart=/bin/sh -c 'sh "\$HIL_JOB/job" >/dev/console 2>&1; echo \$\$? >"\$HIL_JOB/status.part" && mv "\$HIL_JOB/status.part" "\$HIL_JOB/status"'
ExecStopPost=/bin/sh -c 'sync; echo o >/proc/sysrq-trigger'
UNIT

pivot_root . host || refuse "the root stays the host's"
exec chroot . /bin/sh -c '
umount -l /host || { echo o >/proc/sysrq-trigger; sleep 60; }
exec /lib/systemd/systemd --unit=hil.service --show-status=no --log-level=warning --log-target=journal-or-kmsg
'
