# Every callback ran and the hot path was measured; beside r2r, each middleware with each way to execute callbacks.
def run:
  lacks({
    string: "system mode", boolean: "realtime", array: "hot_path_ms callbacks",
    count: "cruncher_limit dropped_in_transforms dropped front_lidar_samples front_lidar_without_estimate planner_runs steal_ticks",
    number: ("seconds crunch_ms cpu_percent rss_mib hot_path_average_ms hot_path_p99_ms hot_path_worst_ms both_lidars_average_ms "
      + "both_lidars_worst_ms planner_jitter_average_ms planner_jitter_worst_ms planner_drift_ms")}),
  (.callbacks | select(length != 25) | "\(length) callbacks instead of 25"),
  (.callbacks[] | select(.runs == 0) | "a callback never ran: \(.)"),
  (select(.hot_path_ms == [] or .front_lidar_samples != .front_lidar_without_estimate + (.hot_path_ms | length))
    | "\(.front_lidar_samples) samples of the front lidar, \(.front_lidar_without_estimate) of them lost, make no \(.hot_path_ms | length) estimates");
if beside then
  (.systems[] | run),
  ([["tautline", "system.toml"], ["tautline", "flat.toml"], ["r2r", "one LocalPool"], ["r2r", "a thread each"]]
    - [.systems[] | [.system, .mode]] | .[] | "nothing was measured of \(.)")
else
  run,
  (select(.realtime != realtime) | "realtime is \(.realtime)"),
  # Without, or if the machine is slower than the system file says, there is nothing to compare with.
  (. as $run | "hot_path_bound_ms", "planner_jitter_bound_ms" | . as $bound
    | select(($run | has($bound) | not) or ($run[$bound] | . != null and (realtime and type == "number" | not))) | "'\($bound)' is \($run[$bound])")
end
