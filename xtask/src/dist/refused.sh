# SPDX-License-Identifier: MIT OR Apache-2.0
# What those get told whose machine or installation is not as it must be: after the commands of docs/from-rclpy.md, where they were run.
say "what is refused"
refused() { # $1 is said by the rest.
    expected=$1
    shift
    said=$(timeout 30 "$@" 2>&1) && echo "it succeeds: $*" && exit 1
    case $said in *"$expected"*) ;; *) echo "not '$expected': $said"; exit 1 ;; esac
    echo "$said" | while read -r line; do case $line in *"$expected"*) echo "$line" ;; esac; done
}
refused "ROS_DISTRO is kilted, but ros-rmw 7.3.2 is of jazzy" env ROS_DISTRO=kilted python3 listener.py
mkdir -p other/ros_rmw-7.1.2.dist-info
printf 'Metadata-Version: 2.1\nName: ros-rmw\nVersion: 7.1.2\n' > other/ros_rmw-7.1.2.dist-info/METADATA
refused "it is built for jazzy, and ros-rmw 7.1.2 is of iron" env PYTHONPATH=other python3 listener.py
# Another version's domain: a file of the same size.
domain=/dev/shm/taut_7_$(id -u)
mkdir -m 700 "$domain"
head -c "$(stat -c %s "/dev/shm/taut_0_$(id -u)/domain")" /dev/zero | tr '\0' '\1' > "$domain/domain"
for said in "taut topic pub /chatter std_msgs/msg/String {} --once" "python3 listener.py"; do
    refused "is of another version of Tautline: use the same one in all processes of a domain" env ROS_DOMAIN_ID=7 $said
done
rm -r "$domain"
mkdir -m 700 "$domain"
chown 1001 "$domain"
refused "it belongs to user 1001: remove it as that user, or as root" env ROS_DOMAIN_ID=7 taut topic pub /chatter std_msgs/msg/String {} --once
rm -rf "$domain"
for said in "taut topic pub /chatter std_msgs/msg/String {} --once" "taut demo" "python3 listener.py"; do
    refused "Read-only file system (os error 30); mount -o remount,rw /dev/shm" /usr/bin/unshare --mount /bin/sh -euc \
        "/usr/bin/mount -o remount,bind,ro /dev/shm; $said"
done
refused "needs CAP_SYS_NICE: run \`sudo setcap cap_sys_nice,cap_ipc_lock+ep " \
    /usr/bin/prlimit --rtprio=0 /usr/bin/setpriv --bounding-set=-sys_nice taut gateway --domain 7
pip install --quiet --target old --no-deps pip==20.0.2
refused "This pip is too old for the wheel of taut" env PYTHONPATH=old python3 -m pip install --no-deps --no-index \
    --find-links "target/dist/pypi" --target new taut
python3 -m tarfile -e "target/dist/pypi/rmw_tautline-$VERSION.tar.gz"
refused "and this system has glibc 2.31" env PYTHONPATH="rmw_tautline-$VERSION" python3 -c '
import no_wheel
no_wheel.platform.libc_ver = lambda: ("glibc", "2.31")
no_wheel.build_wheel("wheels")'
