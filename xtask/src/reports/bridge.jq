# All that was published came through both ways, once and in order, and what it cost is beside r2r's.
rows({string: "experiment system what unit", number: "p50", count: "n"}),
(["from ROS", "to ROS"] - [.[] | .experiment] | .[] | "nothing was measured \(.)"),
([.[] | select(.what == "from publishing to the subscriber, by the bridge")] | (select(length != 2) | "\(length) ways instead of 2"),
  (.[] | select(.n != expected) | "\(expected) messages were expected: \(.)")),
(.[] | select(.aim.must and (.aim.is_met | not)) | "missed: \(.)")
