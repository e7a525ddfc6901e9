"""Many touches at once on a GPU: warp_batch.WarpBatch, and the kernels that it is made of, in NVIDIA Warp."""

from stmpl_core.extras import needed

needed("stmpl_core.gpu", "gpu", "warp")
