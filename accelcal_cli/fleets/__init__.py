"""Many sensors at once: cut into blocks, run here, in processes or on a cluster, kept and gone on with."""
