package org.psao;

/**
 * What a client may hold, and how it is used. Zero is the default; the counts are yours to say, or
 * {@link #fromStream} takes them from a stream. Plain data: a client reads it when it is made.
 */
public final class PsaoConfig {
    /** How many numbers it has for native code, in the order of {@link #words}. */
    private static final int WORDS = 12;

    /**
     * One thread pushes and another takes; the buffers are then held twice. Otherwise the same
     * thread does both, or you lock.
     */
    public boolean twoThreads;
    /** Hash of the scene you loaded; 0 accepts any. */
    public long sceneHash;
    /**
     * {@link PsaoClient#status} calls a client stale for which the link showed no sign of life for
     * so long, in nanoseconds. 0: never for that reason.
     */
    public long staleAfterNs;
    /** Most instances. */
    public long instanceCount;
    /** Most buckets, of all instances. */
    public long bucketCount;
    /** Most cells, of all instances, and one. */
    public long cellCount;
    /** Most slices. This and the next three are 0 for streams of profile cells. */
    public long sliceCount;
    /** Most points of slices that are open at a time. */
    public long pointCount;
    /** Most patches: parts of meshes with their points. */
    public long patchCount;
    /** Most bytes of all patches. */
    public long topologyBytes;
    /** Largest packet, in bytes. 0: the format's limit, 4 MiB. */
    public long maxBodyBytes;
    /** Largest decompressed packet, in bytes. 0: the format's limit, 4 MiB. */
    public long maxRawBytes;

    /** Zero everywhere. */
    public PsaoConfig() {}

    /**
     * Makes a config with just what a stream needs, from its first bytes: of a recording, or of
     * what a server sends. The buffer's position stays. Check {@link #memoryBytes} against your
     * own limit: a hostile server may ask for a lot.
     *
     * <p>Threads: any. Makes garbage. Safe on untrusted input.
     *
     * @param first the stream's first bytes, from the buffer's position to its limit
     * @return null until they hold the first packet; the first 4116 bytes always do
     * @throws PsaoException {@link PsaoResult#ERROR_NOT_A_STREAM} and the others of a stream
     */
    public static PsaoConfig fromStream(PsaoBuffer first) {
        int from = first.bytes().position();
        int bytes = Math.max(0, first.bytes().limit() - from);
        long[] words = new long[WORDS];
        int result = PsaoException.check(
                Native.configFromStream(first.address + from, bytes, words, first));
        if (result == PsaoResult.NEED_MORE) {
            return null;
        }
        PsaoConfig config = new PsaoConfig();
        config.instanceCount = words[3];
        config.bucketCount = words[4];
        config.cellCount = words[5];
        config.sliceCount = words[6];
        config.pointCount = words[7];
        config.patchCount = words[8];
        config.topologyBytes = words[9];
        config.maxBodyBytes = words[10];
        config.maxRawBytes = words[11];
        return config;
    }

    /**
     * Says how much memory a client with this config takes: all that it ever uses. It is a direct
     * buffer's; on Android that counts towards the app's heap ({@code android:largeHeap}).
     *
     * <p>Threads: any. Makes garbage.
     *
     * @return bytes
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: a count is below 0 or above 2^32 - 1, a
     *     packet's limit is below 64 or above the format's, or no machine has so much memory
     */
    public long memoryBytes() {
        long bytes = Native.blockBytes(words());
        if (bytes < 0) {
            throw new PsaoException((int) bytes, "");
        }
        return bytes;
    }

    /** As native code reads them. */
    long[] words() {
        return new long[] {
            twoThreads ? 1 : 0, sceneHash, staleAfterNs, instanceCount, bucketCount, cellCount,
            sliceCount, pointCount, patchCount, topologyBytes, maxBodyBytes, maxRawBytes
        };
    }
}
