package org.psao;

import java.nio.ByteBuffer;

/**
 * The native methods. Addresses are trusted, so that nobody else may call them; the objects at the
 * end only keep alive what the addresses point to.
 */
final class Native {
    /** Of the sources that this was compiled with. */
    private static final int VERSION = 100;

    static {
        System.loadLibrary("psao_jni");
        if (version() != VERSION) {
            throw new UnsatisfiedLinkError("psao_jni is version " + version() + ", and its Java "
                    + "classes are " + VERSION + ": take both from the same release");
        }
    }

    private Native() {}

    static native int version();

    static native String resultText(int result);

    static native long address(ByteBuffer buffer);

    static native int configFromStream(long input, int inputBytes, long[] outConfig, Object keep);

    static native long blockBytes(long[] config);

    static native long openLog(PsaoLog log);

    static native void closeLog(long log);

    static native int init(long[] config, long block, long blockBytes, long log, long words);

    static native long push(
            long client, long input, int inputBytes, long nowNs, Object keep, Object keepInput);

    static native int restart(long client, Object keep);

    static native int header(long client, long words, Object keep, Object keepWords);

    static native int status(long client, long nowNs, long words, Object keep, Object keepWords);

    static native int topologyHash(long client, long words, Object keep);

    static native int stats(long client, long words, Object keep, Object keepWords);

    static native String errorText(long client, Object keep);

    static native int take(long client, long words, Object keep);

    static native int dirtyRanges(
            long client, int buffer, int joinCount, long ranges, int capacityCount, Object keep);

    static native int tagBuckets(
            long client, int firstIndex, int count, long outBuckets, Object keep, Object keepOut);

    static native int lookup(
            long client, int instanceIndex, long positions, long normals, int count,
            long outOpenness, Object keep, Object keepPositions, Object keepNormals,
            Object keepOut);

    static native int release(long client, Object keep);

    static native int markAllDirty(long client, Object keep);

    static native int hello(
            long uplink, long[] config, byte[] token, long topologyHash, long out,
            int capacityBytes, Object keep);

    static native int camera(
            long uplink, float fovYRad, float aspect, int heightPx,
            double positionXM, double positionYM, double positionZM,
            float forwardX, float forwardY, float forwardZ, float upX, float upY, float upZ,
            long out, int capacityBytes, Object keep);

    static native int transform(
            long uplink, int instanceIndex, double[] worldFromLocal, long out, int capacityBytes,
            Object keep);

    static native int joints(
            long uplink, int instanceIndex, long localFromRest, int jointCount, long out,
            int capacityBytes, Object keep, Object keepJoints);

    static native int presence(
            long uplink, int instanceIndex, int present, long out, int capacityBytes, Object keep);

    static native int ack(long uplink, int frameId, long out, int capacityBytes, Object keep);

    static native int resync(long uplink, long out, int capacityBytes, Object keep);
}
