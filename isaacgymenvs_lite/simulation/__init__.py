"""Steps the simulator; tasks read and write batched tensors."""
