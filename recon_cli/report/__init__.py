"""`recon report`: one page about a workspace, in one file that needs nothing beside it."""
