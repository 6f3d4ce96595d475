# Rows with these fields and no others. These experiments and systems are there, and Tautline beside each rival; where messages come one by
# one, it loses none.
def kind: .experiment | split("/")[0];
def optional: ["p50_us", "p99_us", "p999_us", "max_us", "cpu_us_per_msg", "rss_mib"];
def known: optional + ["experiment", "system", "mode", "note", "payload_bytes", "n", "lost", "rounds", "unfit", "mb_per_s", "throttled"];
def measured: .[] | select(.n != 0);
def cell: {experiment, payload_bytes};
(.[] | lacks({string: "experiment system mode note", count: "payload_bytes n lost"}),
  (keys - known | select(length != 0) | "a row with fields \(.)"),
  (optional - keys | select(length != 0) | "a row without fields \(.)"),
  # Few times have no high quantiles, and a start has no cost for each message.
  (. as $row | optional[] | . as $name | $row[$name]
    | select(type != "number" and . != null) | "'\($name)' is no number in \($row)"),
  (select(.n != 0) | lacks({number: "p50_us max_us"})),
  (select(.n == 0 and .note == "") | "nothing was measured and nothing says why: \(.)")),
(experiments - [measured | kind] | .[] | "nothing was measured of \(.)"),
(systems - [measured | .system] | .[] | "nothing was measured of \(.)"),
([measured | cell] - [measured | select(.system == "tautline") | cell] | .[] | "tautline has no row beside \(.)"),
(.[] | select(.system == "tautline" and .lost != 0 and (kind == "latency" or kind == "request")) | "tautline lost messages: \(.)")
