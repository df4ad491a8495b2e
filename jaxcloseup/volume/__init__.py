"""Volume rendering: ray sampling, encodings, compositing and the NeRF built of them."""
