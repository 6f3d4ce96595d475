# Each question is answered, and no process has left files in shared memory.
def left: .rows[] | select(.what == "files left in /dev/shm");
lacks({string: "machine versions disturbance", count: "open_files", boolean: "realtime quick", array: "rows"}),
(.rows | rows({string: "experiment system what unit", count: "size n", number: "p50"})),
(["processes", "topics", "storm", "nodes", "crowd", "load", "images", "fan-out"] - [left | .experiment] | .[]
  | "nothing was measured of '\(.)'"),
(left | select(.p50 != 0) | "files are left: \(.)"),
(["tautline", "iceoryx2"] - [.rows[] | select(.experiment == "load") | .system] | .[] | "nothing was measured of \(.) under load")
