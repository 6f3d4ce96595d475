rows({string: "case implementation", count: "bytes n", number: "p50_us p99_us ratio_to_plain_buffer"})
