//! Topics over shared memory, and the doorbell that announces their samples
