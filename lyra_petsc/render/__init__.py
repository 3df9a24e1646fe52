"""Pictures and films of a run, drawn off-screen; a script that opens it in ParaView."""
