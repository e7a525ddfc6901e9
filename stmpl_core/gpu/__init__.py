"""Many touches at once on a GPU: WarpBatch, and the kernels it is made of, in NVIDIA Warp."""
