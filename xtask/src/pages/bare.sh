# SPDX-License-Identifier: MIT OR Apache-2.0
# Runs the script $1 as on a machine with Python, a shell's programs and Debian's packages, and with packages of `cargo xtask dist` in target/dist: no
# checkout, no cargo, an empty home folder, nothing in shared memory. $BARE is an empty folder, $PACKAGES and $PYTHON are set. Its processes end
# with it, and what it installs.
if [ "${INSIDE-}" = "" ]; then
    [ "$(id -u)" = 0 ] || user=--map-root-user
    exec unshare ${user-} --mount --propagation private --pid --fork --kill-child env INSIDE=1 sh -eu "$0" "$1"
fi
root=$BARE/root home=/home/robot PATH=$PATH:/usr/sbin
chroot=$(command -v chroot)
mkdir "$root"
mount -t tmpfs tmpfs "$root"
# What is at $1 of the machine is there, and at $2 of the root, to be read unless there is a $3.
see() {
    mkdir -p "$root$2"
    mount --rbind "$1" "$root$2"
    [ "${3-}" ] || mount -o remount,bind,ro "$root$2"
}
for folder in /bin /lib /lib32 /lib64 /sbin; do if [ -h $folder ]; then cp -d $folder "$root"; fi; done
# The same, and what is changed there is thrown away.
for folder in /usr /etc /var; do
    mkdir -p "$root$folder" "$root/.changed$folder/new" "$root/.changed$folder/work"
    layers=lowerdir=$folder,upperdir=$root/.changed$folder/new,workdir=$root/.changed$folder/work
    mount -t overlay overlay -o "$layers" "$root$folder"
done
# In a container they are mounts of their own, which an overlay lacks.
for file in /etc/resolv.conf /etc/hosts; do
    if mountpoint -q "$file"; then mount --bind "$file" "$root$file"; fi
done
# An ordinary user installs none of Debian's packages. Nobody searches for manual pages.
if [ -w "$root/var/lib/dpkg" ]; then
    echo 'APT::Sandbox::User "root";' > "$root/etc/apt/apt.conf.d/bare"
    rm -f "$root/var/lib/man-db/auto-update"
fi
mount -t tmpfs tmpfs "$root/usr/local"
# pip's own settings say where this machine finds packages.
for folder in "$("$PYTHON" -c 'import sys; print(sys.base_prefix)')" ${PIP_FIND_LINKS-}; do
    if [ "$folder" != /usr ] && [ -d "$folder" ]; then see "$folder" "$folder"; fi
done
for folder in /dev /sys ${PIP_CACHE_DIR-}; do
    mkdir -p "$folder"
    see "$folder" "$folder" writable
done
mkdir -p "$root/proc" "$root/tmp" "$root$home/.path"
chmod 1777 "$root/tmp"
mount -t proc proc "$root/proc"
mount -t tmpfs tmpfs "$root/dev/shm"
see "$PACKAGES" "$home/target/dist"
path=$root$home/.path
for program in $(dpkg -L coreutils dpkg gzip tar | grep /bin/); do ln -s "$program" "$path"; done
ln -s "$("$PYTHON" -c 'import sys; print(sys._base_executable)')" "$path/python3"
# It is root in here.
printf '#!/bin/sh\nPATH=$PATH:/usr/sbin:/usr/bin exec "$@"\n' > "$path/sudo"
chmod +x "$path/sudo"
cp "$1" "$path/.script"
for name in $(env | sed -n 's/^\([A-Z_]*\)=.*/\1/p'); do
    case $name in PIP_* | TAUT_REALTIME | VERSION) ;; *) unset "$name" ;; esac
done
export PATH="$home/.path:/usr/local/bin" HOME="$home"
exec "$chroot" "$root" /bin/sh -euc 'cd "$HOME" && . "$HOME/.path/.script"'
