package org.psao;

/** What the native library does only for tests, with the feature {@code provoke}. */
final class Provoke {
    private Provoke() {}

    /** A panic in a client's function. */
    static native int panicOfClient(long client, Object keep);

    /** A panic on the way from Java to it. */
    static native int panicOnTheWay();

    /** Restarts a client on a thread that the virtual machine does not know. */
    static native int restartElsewhere(long client, Object keep);
}
