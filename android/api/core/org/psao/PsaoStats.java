package org.psao;

/**
 * Totals since a client was made, and its newest frame: filled in by {@link PsaoClient#stats}.
 * Make one and keep it.
 */
public final class PsaoStats {
    final Words words = new Words(14);

    /** All zero, until a client fills it in. */
    public PsaoStats() {}

    /**
     * Number of the newest complete frame.
     *
     * @return a number, of 32 bits without sign
     */
    public int frameId() {
        return (int) words.get(0);
    }

    /**
     * Its scene time.
     *
     * @return nanoseconds
     */
    public long serverTimeNs() {
        return words.get(1);
    }

    /**
     * How much later it came than the fastest frame of this stream, by your clock.
     *
     * @return nanoseconds
     */
    public long delayNs() {
        return words.get(2);
    }

    /**
     * Hash of its mirror. The server says the upper half with each frame, of the bytes it means.
     *
     * @return 64 bits
     */
    public long mirrorHash() {
        return words.get(3);
    }

    /**
     * Bytes pushed and used.
     *
     * @return bytes
     */
    public long streamBytes() {
        return words.get(4);
    }

    /**
     * Complete frames.
     *
     * @return a count
     */
    public long frameCount() {
        return words.get(5);
    }

    /**
     * Snapshots among them.
     *
     * @return a count
     */
    public long snapshotCount() {
        return words.get(6);
    }

    /**
     * Frames that were discarded because the mirror's hash was not the server's.
     *
     * @return a count
     */
    public long discardedCount() {
        return words.get(7);
    }

    /**
     * Frames that went into a later one because the taker was busy or late.
     *
     * @return a count
     */
    public long mergedCount() {
        return words.get(8);
    }

    /**
     * Instances received.
     *
     * @return a count
     */
    public long instanceCount() {
        return words.get(9);
    }

    /**
     * Buckets received.
     *
     * @return a count
     */
    public long bucketCount() {
        return words.get(10);
    }

    /**
     * Cells received.
     *
     * @return a count
     */
    public long cellCount() {
        return words.get(11);
    }

    /**
     * Changes of slices received.
     *
     * @return a count
     */
    public long sliceCount() {
        return words.get(12);
    }

    /**
     * Patches received.
     *
     * @return a count
     */
    public long patchCount() {
        return words.get(13);
    }
}
