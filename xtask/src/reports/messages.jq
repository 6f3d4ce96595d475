rows({string: "experiment system mode", count: "payload_bytes n", number: "p50_us p99_us", array: "rounds"})
