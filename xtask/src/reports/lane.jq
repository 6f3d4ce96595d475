# Each way to share was measured, no message of Tautline's was lost, and the car kept its lane.
(.[] | lacks({string: "system shared", boolean: "realtime", array: "rows lost", number: "chain_below_paper", count: "published steal_ticks"})),
(["latest", "inherit", "mutex"] - [.[] | select(.system == "Tautline") | .shared] | .[] | "Tautline with '\(.)' is missing"),
(.[] | select(.system == "Tautline")
  | (.rows[] | lacks({string: "span name", count: "n", number: "p50_ms p99_ms p999_ms max_ms", array: "values"})),
    (["Chain", "Imu", "Odometry", "Subscriber", "Timer", "Planning", "Draw"] - [.rows[] | select(.n != 0) | .span] | .[] | "nothing is known of '\(.)'"),
    (select(.lost != []) | "messages were lost: \(.lost)"),
    (.drive | lacks({number: "lateral_max_m", count: "collisions"}), (select(.lateral_max_m > 0.6 or .collisions != 0)
      | "the car was \(.lateral_max_m) m off the lane's centre, with \(.collisions) collisions")))
