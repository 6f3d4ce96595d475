# Five topics, each with messages; in real time where that is permitted.
lacks({boolean: "realtime", count: "core steal_ticks", number: "seconds", string: "kernel", array: "topics"}),
(select(realtime and .realtime == false) | "it ran without real-time priorities"),
(.topics | select(length != 5) | "\(length) topics instead of 5"),
(.topics | rows({
  string: "topic", number: "period_ms wcet_ms p50_ms p99_ms max_ms rta_ms",
  count: "priority n beyond unexplained deadline_misses lost max_queue"})),
(.topics[] | select(.lost != 0) | "messages were lost: \(.)"),
# Where the host's overhead leaves too little of the core there is no bound.
(.topics[] | . as $topic | ("rta_overhead_ms", "rta_host_ms") as $bound
  | select(($topic | has($bound) | not) or ($topic[$bound] | type != "number" and . != null)) | "'\($bound)' is no bound in \($topic)")
