"""The federated filter: local filters by source, fault detection, fusion."""
