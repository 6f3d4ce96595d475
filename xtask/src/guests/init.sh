#!/bin/busybox sh
# The first process of a guest: does what /jobs says, and tells how that went in lines that begin with `@`.
# Runs a command, whose output goes to /tmp/said, and ends what it leaves behind.
attempt() {
    timeout -s KILL 300 "$@" >/tmp/said 2>&1 </dev/null
    code=$?
    kill -9 -1 2>/dev/null
    rm -rf /dev/shm/*
    return $code
}

# The same for a test, which may fail once, as in CI.
trial() { # its name, the command
    name=$1; shift
    if attempt "$@"; then echo "@pass $name"
    elif cp /tmp/said /tmp/before; attempt "$@"; then echo "@flaky $name"; sed 's/^/@said /' /tmp/before | tail -n 20
    else echo "@fail $name: exit code $code"; sed 's/^/@said /' /tmp/said | tail -n 20
    fi
}

# Each test of an executable, in a process of its own.
tests() { # its name
    echo "@begin $1"
    file=/tests/$(echo "$1" | tr / -)
    $file --list --format terse >/tmp/tests 2>&1 </dev/null || echo "@fail $1: its tests cannot be listed"
    for test in $(sed -n 's/: test$//p' /tmp/tests); do
        trial "$1 $test" $file --exact "$test" --nocapture --test-threads 1
    done
}

program() { # its name, the command
    echo "@begin $1"
    trial "$@"
}

# Programs with their arguments, separated by `|`: each is started when the one before has printed its first line, and prints what is expected.
together() {
    result=0 children=
    IFS='|'; set -- $1; unset IFS
    for command; do
        to=/tmp/${command%% *}.txt
        : >$to
        $command >$to &
        children="$children $!"
        while [ ! -s $to ] && kill -0 $! 2>/dev/null; do sleep 0.1; done
    done
    for child in $children; do wait $child || result=$?; done
    for command; do diff /expected/${command%% *}.txt /tmp/${command%% *}.txt || result=1; done
    return $result
}

# What `taut doctor` is to see here: that budgets are enforced, that this machine is virtual, and which interrupts are no devices'.
doctor() {
    taut doctor --json | tee /tmp/doctor | tr '{' '\n' | grep -E '"check":"(budgets|steal|interrupts)"'
    grep -qE '"check":"budgets"[^}]*\(tried\)' /tmp/doctor && grep -q 'this is a virtual machine' /tmp/doctor && ! grep -q arch_timer /tmp/doctor
}

# A new system file has bounds.
bounds() {
    rm -f /tmp/robot.toml && taut init /tmp/robot.toml && taut check /tmp/robot.toml
}

# A message crosses two gateways.
hosts() {
    taut gateway --domain 1 --listen tcp/127.0.0.1:7447 &
    taut gateway --domain 2 --network-domain 1 --connect tcp/127.0.0.1:7447 --listen tcp/127.0.0.1:0 &
    taut topic pub --domain 1 /chatter std_msgs/msg/String '{data: hello}' --rate 10 &
    taut topic echo --domain 2 /chatter --once --timeout 200s
}

case $1 in together | doctor | bounds | hosts) "$@"; exit $? ;; esac

/bin/busybox mkdir -p /proc /sys /dev /tmp /run /root
/bin/busybox --install -s /bin
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev
mkdir -p /dev/shm /dev/pts
mount -t tmpfs -o mode=1777 shm /dev/shm; mount -t tmpfs -o mode=1777 tmp /tmp; mount -t devpts pts /dev/pts
mount -t cgroup2 cgroup /sys/fs/cgroup; mount -t debugfs debug /sys/kernel/debug
ln -s /proc/self/fd /dev/fd
ifconfig lo 127.0.0.1 up; hostname guest
export PATH=/programs:/bin HOME=/root USER=root CI=true TAUT_SCOPE=guest TAUT_TIME_SCALE=50

echo "@guest $(uname -srvm), $(nproc) cores, $(grep -m 1 KernelPageSize /proc/self/smaps)"
. /jobs
dmesg | grep -E 'BUG:|WARNING:|scheduling while atomic|rcu.*stall|soft lockup|blocked for more' | sed 's/^/@kernel /'
echo "@end"
poweroff -f
