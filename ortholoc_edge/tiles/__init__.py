"""Area packs: DOP and DSM from disk to arrays on a `RasterGrid`."""
