# With the sampler below the callbacks the three fastest topics miss deadlines, or the measurement cannot fail.
.topics[:3][] | select(.deadline_misses == 0) | "no deadline was missed: \(.)"
