"""Who may do what: certificates, access rules derived from the contract, and a router that enforces them."""
