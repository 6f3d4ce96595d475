# In real time, where one thread serves all topics the fastest miss deadlines, and a queue that is too short loses messages, or the measurement
# cannot fail.
def of(variant): [.[] | select(.variant == variant)];
rows({string: "system variant topic", count: "runs n misses lost steal_ticks",
  number: "p50_ms p99_ms max_ms p99_std_ms rta_ms deadline_ms"}),
(. as $rows | "futures", "futures-rt", "tokio", "nort-tokio", "futures-rt-mw-below" | . as $variant
  | $rows | of($variant) | select(length != 5) | "\($variant) has \(length) topics instead of 5"),
(select(realtime)
  | (of("futures")[:3][] | select(.misses == 0) | "no deadline was missed: \(.)"),
    (select(of("capacity-15") | all(.lost == 0)) | "a queue of 15 lost nothing where 16 are needed"))
