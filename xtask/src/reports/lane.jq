# Each way to share was measured, and what must hold holds: the lane was kept, no message lost.
(.[] | lacks({string: "system shared", boolean: "realtime", array: "rows verdicts lost", object: "drive", count: "steal_ticks"})),
(["latest", "inherit", "mutex"] - [.[] | select(.system == "tautline") | .shared] | .[] | "tautline with '\(.)' is missing"),
(.[] | select(.system == "tautline") | .rows
  | rows({string: "experiment system what unit", count: "n", number: "p50"}),
    (["odometry chain, end to end", "adapter: IMU callback", "ALKS: odometry callback", "ALKS: all subscribers",
      "ALKS: timer without planning", "ALKS: timer with planning", "visualizer: markers"] - map(.what) | .[] | "nothing is known of '\(.)'"),
    ([.[] | select(.aim.must)] | (select(length != 3) | "\(length) of three were judged"), (.[] | select(.aim.is_met | not) | "missed: \(.)")))
