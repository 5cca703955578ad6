#!/bin/busybox sh
# First process of the guest: loads the modules, puts a writable layer over the host's file tree, runs
# /results/command in it, leaves the exit status in /results/status and ends QEMU with the same status.
give_up() {
    echo "$1"
    poweroff -f
}

/bin/busybox --install -s /bin
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs devtmpfs /dev
for module in /modules/*; do
    insmod "$module" || echo "module $module does not load"
done

share=trans=virtio,version=9p2000.L,msize=524288
mount -t 9p -o $share,cache=loose,ro host /host || give_up "the host's files cannot be mounted"
mount -t tmpfs -o size=75% layer /layer
mkdir /layer/upper /layer/work
mount -t overlay -o lowerdir=/host,upperdir=/layer/upper,workdir=/layer/work overlay /guest ||
    give_up 'the writable layer cannot be mounted'
mkdir -p /guest/results
mount -t 9p -o $share,cache=none results /guest/results || give_up 'the folder for results cannot be mounted'
mount --move /proc /guest/proc
mount --move /sys /guest/sys
mount --move /dev /guest/dev
mkdir -p /guest/dev/shm /guest/dev/pts
mount -t tmpfs shm /guest/dev/shm
mount -t devpts devpts /guest/dev/pts

chroot /guest /bin/sh /results/command >/guest/results/output 2>&1 </guest/dev/null
status=$?
echo $status >/guest/results/status.new
mv /guest/results/status.new /guest/results/status
sync
# isa-debug-exit: QEMU ends with 2 * byte + 1.
[ $status -lt 127 ] || status=126
printf "\\x$(printf %x $status)" | dd of=/guest/dev/port bs=1 seek=$((0x501)) conv=notrunc 2>/dev/null
