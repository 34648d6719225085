package org.psao;

/**
 * What a stream says of itself: filled in by {@link PsaoClient#header}. Make one and keep it.
 */
public final class PsaoHeader {
    final Words words = new Words(10);

    /** All zero, until a client fills it in. */
    public PsaoHeader() {}

    /**
     * How occlusion is coded.
     *
     * @return 0 cells, 1 residual
     */
    public int profile() {
        return (int) words.get(0);
    }

    /**
     * Kernel for the lookup.
     *
     * @return 0 paper, 1 planar
     */
    public int kernel() {
        return (int) words.get(1);
    }

    /**
     * Elements of the instance buffer.
     *
     * @return a count, of 32 bits without sign
     */
    public int instanceCount() {
        return (int) words.get(2);
    }

    /**
     * Elements of the bucket buffer.
     *
     * @return a count, of 32 bits without sign
     */
    public int bucketCount() {
        return (int) words.get(3);
    }

    /**
     * Elements of the cell buffer.
     *
     * @return a count, of 32 bits without sign
     */
    public int cellCount() {
        return (int) words.get(4);
    }

    /**
     * Hash of the server's scene.
     *
     * @return 64 bits
     */
    public long sceneHash() {
        return words.get(5);
    }

    /**
     * Longest ray.
     *
     * @return metres
     */
    public float aoDistanceM() {
        return words.real(6);
    }

    /**
     * Points per square metre and side.
     *
     * @return a density
     */
    public float density() {
        return words.real(7);
    }

    /**
     * Server frames per second.
     *
     * @return hertz
     */
    public float rateHz() {
        return words.real(8);
    }

    /**
     * Occlusion may be off by so many 1/255.
     *
     * @return 0 to 255
     */
    public int threshold() {
        return (int) words.get(9);
    }
}
