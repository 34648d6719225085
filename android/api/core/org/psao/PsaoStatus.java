package org.psao;

/**
 * How a client is: filled in by {@link PsaoClient#status}. Make one for each thread that asks.
 */
public final class PsaoStatus {
    /** No frame has come yet. Draw without AO: everything is open. */
    public static final int CONNECTING = 0;
    /** The last frame is the server's. */
    public static final int LIVE = 1;
    /**
     * The last frame is older than it should be. Go on drawing it: it freezes, and catches up
     * without a flash.
     */
    public static final int STALE = 2;
    /** The server ended the stream. The last frame stays good. */
    public static final int ENDED = 3;
    /**
     * A push failed. The last frame stays in place; {@link PsaoClient#restart} and a new stream go
     * on from it.
     */
    public static final int FAILED = 4;

    final Words words = new Words(2);

    /** All zero, until a client fills it in. */
    public PsaoStatus() {}

    /**
     * Where the client is in its stream.
     *
     * @return one of the constants
     */
    public int state() {
        return (int) words.get(0);
    }

    /**
     * The last time at which the frame was the server's: while not live, AO is what it was
     * then.
     *
     * @return nanoseconds by your clock; 0: never
     */
    public long liveNs() {
        return words.get(1);
    }
}
