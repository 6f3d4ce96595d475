# Each question is answered.
lacks({string: "machine versions disturbance", count: "open_files", boolean: "realtime quick", array: "rows"}),
(.rows | rows({string: "experiment system what unit", count: "size n", number: "p50"})),
(["processes", "topics", "storm", "nodes", "crowd", "load", "images", "fan-out"] - [.rows[].experiment] | .[]
  | "nothing was measured of '\(.)'"),
(["tautline", "iceoryx2"] - [.rows[] | select(.experiment == "load") | .system] | .[] | "nothing was measured of \(.) under load")
