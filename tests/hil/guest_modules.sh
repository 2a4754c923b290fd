#!/bin/sh
# The CAN modules of a User Mode Linux guest, which lie apart from the host's and are not indexed.
modules=/usr/lib/uml/modules/$(uname -r)/kernel
for module in net/can/can net/can/can-raw drivers/net/can/dev/can-dev drivers/net/can/vcan; do
    insmod "$modules/$module.ko" || echo "guest: cannot load $module.ko" >&2
done
