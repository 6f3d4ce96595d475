# SPDX-License-Identifier: MIT OR Apache-2.0
# What the README promises to those who install the wheels of $OUT: with $PYTHON and coreutils alone, and an empty $HOME.
mkdir -p "$HOME/path"
python=$("$PYTHON" -c 'import sys; print(sys._base_executable)')
for program in $(dpkg -L coreutils | grep /bin/); do ln -s "$program" "$HOME/path"; done
ln -s "$python" "$HOME/path/python3"
# What a shell has that starts here. pip's own settings say where this machine finds packages.
for name in $(env | sed -n 's/^\([A-Z_]*\)=.*/\1/p'); do
    case $name in OUT | HOME | PIP_* | TAUT_* | VERSION) ;; *) unset "$name" ;; esac
done
export PATH="$HOME/path" RMW_IMPLEMENTATION=rmw_tautline
cd "$HOME"
begin=$(date +%s%N)
say() { echo; echo "$(( ($(date +%s%N) - begin) / 1000000 )) ms: $*"; }

say "pip install"
python3 -m venv robot
. robot/bin/activate
pip install --quiet --find-links "$OUT/pypi" "taut==$VERSION" "rmw-tautline==$VERSION" \
    'ros-jazzy-rclpy[fastrtps]==7.1.6' ros-jazzy-std-msgs==5.3.6
say "taut demo"
taut demo --seconds 2
say "taut check"
taut init robot.toml
taut check robot.toml
say "rclpy's talker and listener, taut topic hz"
cat > talker.py <<'END'
import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("talker")
publisher = node.create_publisher(String, "/chatter", 10)
node.create_timer(0.02, lambda: publisher.publish(String(data="hello")))
try:
    rclpy.spin(node)
except rclpy.executors.ExternalShutdownException:
    pass
END
cat > listener.py <<'END'
import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("listener")
heard = []
node.create_subscription(String, "/chatter", heard.append, 10)
while len(heard) < 20:
    rclpy.spin_once(node, timeout_sec=20)
print("heard", heard[-1].data, "on", rclpy.utilities.get_rmw_implementation_identifier())
END
python3 talker.py &
talker=$!
trap 'kill $talker; wait' EXIT
[ "$(timeout 60 python3 listener.py)" = "heard hello on rmw_tautline" ]
taut topic hz /chatter --expect 10..60 --timeout 2s
say "what is refused"
refused() { # $1 is said by the rest.
    expected=$1
    shift
    said=$("$@" 2>&1) && echo "it succeeds: $*" && exit 1
    case $said in *"$expected"*) echo "$said" ;; *) echo "not '$expected': $said"; exit 1 ;; esac
}
refused "it is built for ROS 2 jazzy, and this is kilted (ROS_DISTRO)" env ROS_DISTRO=kilted python3 listener.py
mkdir -p other/ros_rmw-7.8.2.dist-info
printf 'Metadata-Version: 2.1\nName: ros-rmw\nVersion: 7.8.2\n' > other/ros_rmw-7.8.2.dist-info/METADATA
refused "and this is kilted (ros-rmw 7.8.2)" env PYTHONPATH=other python3 listener.py
# Another version's domain: a file of the same size.
domain=/dev/shm/taut_7_$(id -u).$TAUT_SCOPE
mkdir -m 700 "$domain"
head -c "$(stat -c %s "/dev/shm/taut_0_$(id -u).$TAUT_SCOPE/domain")" /dev/zero | tr '\0' '\1' > "$domain/domain"
for said in "taut topic pub /chatter std_msgs/msg/String {} --once" "python3 listener.py"; do
    refused "is of another version of Tautline: use the same one in all processes of a domain" env ROS_DOMAIN_ID=7 $said
done
rm -r "$domain"
pip install --quiet --target old --no-deps pip==20.0.2
refused "This pip is too old for the wheel of taut" env PYTHONPATH=old python3 -m pip install --no-deps --no-index \
    --find-links "$OUT/pypi" --target new taut
python3 -m tarfile -e "$OUT/pypi/rmw_tautline-$VERSION.tar.gz"
refused "and this system has glibc 2.31" env PYTHONPATH="rmw_tautline-$VERSION" python3 -c '
import no_wheel
no_wheel.platform.libc_ver = lambda: ("glibc", "2.31")
no_wheel.build_wheel("wheels")'
say "done"
