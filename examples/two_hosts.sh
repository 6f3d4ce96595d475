#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Two hosts: `listener` on one, `talker` on the other, a gateway on each, and the nodes none the wiser. Or `remote_image`
# on both.
#
#     cargo build --release -p tautline-gateway -p tautline-examples --bins --examples
#     examples/two_hosts.sh [messages] [remote_image]
#
# As root the hosts are network namespaces, each with shared memory of its own, joined by a cable. Otherwise they are
# two domains of this host, joined over loopback. Everything ends with the script.
set -euo pipefail
# Absolute: on a host of its own a program starts in another directory.
built=$(realpath "${TAUT_BUILT:-$(dirname "$0")/../target/release}")
gateway=$(realpath "${TAUT_GATEWAY:-$built/taut-gateway}")
messages=${1:-20}
case ${2:-talker} in
    talker) sender=(talker) receiver=(listener "$messages") ;;
    remote_image) sender=(remote_image send) receiver=(remote_image receive "$messages") ;;
    *) echo "two_hosts.sh: '$2' is neither talker nor remote_image" >&2; exit 2 ;;
esac
hosts=()
trap 'kill $(jobs -p) 2> /dev/null || true; wait' EXIT

# A process that holds the namespaces of a host.
host() {
    unshare --net --mount setpriv --pdeathsig KILL sh -c '
        mount -t tmpfs tmpfs /dev/shm && mkdir -p /tmp/tautline_0 && mount -t tmpfs -o mode=700 tmpfs /tmp/tautline_0 &&
        ip link set lo up && exec sleep infinity' &
    hosts+=($!)
    # Ready once it sleeps.
    until [ "$(cat "/proc/$!/comm")" = sleep ]; do kill -0 $!; done
}

# Runs a command on host 0 or 1.
on() {
    local host=$1 && shift
    if [ ${#hosts[@]} -gt 0 ]; then
        exec nsenter -t "${hosts[$host]}" -n -m -- setpriv --pdeathsig KILL "$@"
    else
        TAUT_DOMAIN=$((224 + host)) exec "$@"
    fi
}

if [ "$(id -u)" = 0 ] && unshare --net --mount true 2> /dev/null; then
    echo "two hosts: network namespaces"
    host && host
    ip link add eth0 netns "${hosts[0]}" type veth peer name eth0 netns "${hosts[1]}"
    for n in 0 1; do
        (on $n ip address add 10.78.0.$((n + 1))/24 dev eth0)
        (on $n ip link set eth0 up)
    done
    endpoint=tcp/10.78.0.1:7447
    options=()
    [ "${TAUT_REALTIME:-}" != off ] || options=(--no-rt)
else
    echo "two hosts: domains 224 and 225 of this host"
    endpoint=tcp/127.0.0.1:7448
    options=(--no-rt --network-domain 224)
fi

(on 0 "$gateway" --listen "$endpoint" --json "${options[@]}" > /dev/null) &
(on 1 "$gateway" --connect "$endpoint" --json "${options[@]}" > /dev/null) &
(on 1 "$built/examples/${sender[0]}" "${sender[@]:1}" > /dev/null) &
(on 0 "$built/examples/${receiver[0]}" "${receiver[@]:1}")
