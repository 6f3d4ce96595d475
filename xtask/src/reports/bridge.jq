# All that was published came through both ways, once and in order, and what it cost is beside r2r's.
(select([.[] | .direction] != ["from_ros", "to_ros"]) | "its ways are \([.[] | .direction])"),
(.[] | (.cpu | lacks({number: "bridge direct bridged publisher machine"})),
  (.direct, .bridged | lacks({count: "messages disordered", number: "p50_us p99_us"})),
  (select(.expected != expected or .bridged.messages != expected or .bridged.disordered != 0)
    | "\(.direction): \(expected) were expected in order, not \(.bridged) of \(.expected)"))
